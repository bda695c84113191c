//! Age of the autopilot's attitude on arrival, by its own clock: `cargo run -p autopilot --example clock --
//! ADDRESS`.
//!
//! It listens for 30 s and sends no command to the vehicle.

#![allow(clippy::print_stdout, reason = "a program for the terminal")]

use std::error::Error;
use std::time::{Duration, Instant};

use autopilot::{Autopilot, Config, Event, Link, LinkEvent};
use tokio::time::interval;

#[tokio::main(flavor = "current_thread")]
async fn main() -> Result<(), Box<dyn Error>> {
    let address = std::env::args().nth(1).unwrap_or_else(|| "udpin:127.0.0.1:14550".to_owned());
    let began = Instant::now();
    let mut link = Link::open(address.parse()?).await?;
    let mut autopilot = Autopilot::new(Config::default());
    let mut ticks = interval(Duration::from_millis(20));
    let mut ages_ms = Vec::new();
    let now_ns = || i64::try_from(began.elapsed().as_nanos()).unwrap_or(i64::MAX);
    while began.elapsed() < Duration::from_secs(30) {
        tokio::select! {
            event = link.recv() => {
                if let LinkEvent::Packet { packet, .. } = event {
                    autopilot.handle(now_ns(), &packet);
                }
            }
            _ = ticks.tick() => autopilot.tick(now_ns()),
        }
        while let Some(packet) = autopilot.poll_outgoing() {
            // While the link is down there is nothing to send to.
            let _ = link.send(&packet);
        }
        while let Some(event) = autopilot.poll_event() {
            if let Event::Attitude(attitude) = event
                && autopilot.round_trip(now_ns()).is_some()
            {
                ages_ms.push((now_ns() - attitude.stamp_ns) as f64 * 1e-6);
            }
        }
    }
    ages_ms.sort_by(f64::total_cmp);
    let at = |part: f64| {
        let index = (ages_ms.len().saturating_sub(1)) as f64 * part;
        ages_ms.get(index as usize).copied().unwrap_or(f64::NAN)
    };
    println!(
        "{} attitudes, shortest round trip {:?}",
        ages_ms.len(),
        autopilot.round_trip(now_ns())
    );
    let [median, late, worst] = [at(0.5), at(0.99), at(1.0)];
    println!("age on arrival: median {median:.1} ms, 99 % {late:.1} ms, worst {worst:.1} ms");
    Ok(())
}
