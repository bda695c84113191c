//! Many modelled landings, as tables: `cargo run --release -p landing --example landings [FLIGHTS]`.

#![allow(clippy::print_stdout, reason = "a program's output")]

#[path = "../tests/world/mod.rs"]
mod world;

use world::report::{HEADER, row};
use world::{Flight, Scene};

fn fly(flights: u64, scene: impl Fn(u64) -> Scene + Sync) -> Vec<Flight> {
    (0..flights).map(|seed| scene(seed).fly()).collect()
}

fn main() {
    let n = std::env::args().nth(1).and_then(|n| n.parse().ok()).unwrap_or(100);
    println!("{HEADER}");
    for (mean, turbulence) in [(0.0, 0.0), (5.0, 1.0), (5.0, 3.0), (8.0, 2.0)] {
        let flights = fly(n, |seed| Scene::windy(seed, mean, turbulence));
        println!("{}", row(&format!("wind {mean} m/s, turbulence {turbulence}"), &flights));
    }
}
