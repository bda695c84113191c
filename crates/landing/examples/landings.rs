//! Flies every named case of modelled landings by the hundred and prints a row of errors and speeds for each:
//! `cargo run --release -p landing --example landings [FLIGHTS [CASE]]`.
//!
//! FLIGHTS is the number of flights of each row (100), ten times as many for the last; CASE is a part of the
//! names of the rows that are flown. A row's flights are those of the seeds from 0 on.

#![allow(clippy::print_stdout, reason = "a program's output")]

#[path = "../tests/scene/mod.rs"]
mod scene;

use scene::cases::{FAULTS, MOVING, WINDS, anything};
use scene::report::{HEADER, row};
use scene::{Flight, Scene};

/// The flights of the seeds from 0 on, on all cores.
fn fly(flights: u64, scene: fn(u64) -> Scene) -> Vec<Flight> {
    let threads = std::thread::available_parallelism().map_or(1, std::num::NonZero::get) as u64;
    let mut all: Vec<(u64, Flight)> = std::thread::scope(|scope| {
        let workers: Vec<_> = (0..threads)
            .map(|first| {
                scope.spawn(move || {
                    let seeds = (first..flights).step_by(threads as usize);
                    seeds.map(|seed| (seed, without_samples(scene(seed).fly()))).collect()
                })
            })
            .collect();
        let parts = workers.into_iter().map(|worker| worker.join().unwrap_or_else(|_| Vec::new()));
        parts.flatten().collect()
    });
    all.sort_by_key(|(seed, _)| *seed);
    all.into_iter().map(|(_, flight)| flight).collect()
}

fn without_samples(flight: Flight) -> Flight {
    Flight { samples: Vec::new(), ..flight }
}

fn main() {
    let mut arguments = std::env::args().skip(1);
    let flights = arguments.next().and_then(|n| n.parse().ok()).unwrap_or(100);
    let desired = arguments.next().unwrap_or_default();
    println!("{HEADER}");
    for (name, scene) in WINDS.into_iter().chain(FAULTS).chain(MOVING) {
        if name.contains(&desired) {
            println!("{}", row(name, &fly(flights, scene)));
        }
    }
    let name = "wind 0-8 m/s, offset 0-4 m, height 5-15 m, latency 20-300 ms";
    if name.contains(&desired) {
        let all = fly(10 * flights, anything);
        println!("{}", row(name, &all));
        for (seed, flight) in all.iter().enumerate() {
            if flight.is_unsafe() || flight.error_m > 0.1 {
                let (phase, error_m) = (flight.phase, flight.error_m);
                println!("seed {seed}: {phase}, {error_m:.3} m, aborted: {}", flight.aborted);
            }
        }
    }
}
