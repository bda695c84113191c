//! How old the autopilot's attitude is on arrival, by its own clock: `cargo run -p autopilot --example clock -- ADDRESS`.
//!
//! It listens for 30 s and commands nothing.

#![allow(clippy::print_stdout, reason = "a program for the terminal")]

use std::error::Error;
use std::time::Instant;

use autopilot::{Config, Event, Happening, Session};

const SECOND: i64 = 1_000_000_000;

#[tokio::main(flavor = "current_thread")]
async fn main() -> Result<(), Box<dyn Error>> {
    let address = std::env::args().nth(1).unwrap_or_else(|| "udpin:127.0.0.1:14550".to_owned());
    let began = Instant::now();
    let clock = move || i64::try_from(began.elapsed().as_nanos()).unwrap_or(i64::MAX);
    let mut session = Session::open(address.parse()?, Config::default(), clock).await?;
    let (mut received_ns, mut now_ns) = (0, 0);
    let mut ages_ms = Vec::new();
    while now_ns < 30 * SECOND {
        match session.next().await {
            Happening::Tick { now_ns: now } => now_ns = now,
            Happening::Packet { stamp_ns, .. } => received_ns = stamp_ns,
            Happening::Vehicle(Event::Attitude(attitude))
                if session.autopilot().round_trip(now_ns).is_some() =>
            {
                ages_ms.push((received_ns - attitude.stamp_ns) as f64 * 1e-6);
            }
            _ => {}
        }
    }
    ages_ms.sort_by(f64::total_cmp);
    let at = |part: f64| {
        let index = (ages_ms.len().saturating_sub(1)) as f64 * part;
        ages_ms.get(index as usize).copied().unwrap_or(f64::NAN)
    };
    let trip = session.autopilot().round_trip(now_ns);
    println!("{} attitudes, shortest round trip {trip:?}", ages_ms.len());
    println!(
        "age on arrival: median {:.1} ms, 99 % {:.1} ms, worst {:.1} ms",
        at(0.5),
        at(0.99),
        at(1.0)
    );
    Ok(())
}
