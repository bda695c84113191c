//! Takes off, flies a little to the north, and lands again: `cargo run -p autopilot --example hop --
//! ADDRESS`.
//!
//! It shows a whole flight with this crate; try it on ArduPilot's simulator with `udpin:127.0.0.1:14550`.

#![allow(clippy::print_stdout, reason = "a program for the terminal")]

use std::error::Error;
use std::time::{Duration, Instant};

use autopilot::{
    Autopilot, Command, Config, Event, FlightMode, Link, LinkEvent, Takeoff, TakeoffProgress,
};
use geometry::Vector;
use tokio::time::interval;

const SECOND: i64 = 1_000_000_000;

#[tokio::main(flavor = "current_thread")]
async fn main() -> Result<(), Box<dyn Error>> {
    let address = std::env::args().nth(1).unwrap_or_else(|| "udpin:127.0.0.1:14550".to_owned());
    let began = Instant::now();
    let now_ns = || i64::try_from(began.elapsed().as_nanos()).unwrap_or(i64::MAX);
    let report = |text: String| println!("{:8.3} {text}", began.elapsed().as_secs_f64());
    let mut link = Link::open(address.parse()?).await?;
    let mut autopilot = Autopilot::new(Config::default());
    let mut ticks = interval(Duration::from_millis(20));
    let mut hop =
        Hop { takeoff: Takeoff::new(10.0), progress: String::new(), since_ns: None, lands: false };
    loop {
        tokio::select! {
            event = link.recv() => match event {
                LinkEvent::Packet { packet, .. } => autopilot.handle(now_ns(), &packet),
                other => report(format!("{other:?}")),
            },
            _ = ticks.tick() => {
                autopilot.tick(now_ns());
                hop.step(now_ns(), &mut autopilot, &report)?;
            }
        }
        while let Some(packet) = autopilot.poll_outgoing() {
            // While the link is down there is nothing to send to.
            let _ = link.send(&packet);
        }
        while let Some(event) = autopilot.poll_event() {
            match event {
                Event::Attitude(_) | Event::Position(_) | Event::State(_) | Event::Range(_) => {}
                Event::ArmedChanged(false) if hop.lands => {
                    report("disarmed: the end".to_owned());
                    return Ok(());
                }
                other => report(format!("{other:?}")),
            }
        }
    }
}

struct Hop {
    takeoff: Takeoff,
    progress: String,
    /// When the takeoff was done, in ns.
    since_ns: Option<i64>,
    /// LAND was requested.
    lands: bool,
}

impl Hop {
    fn step(
        &mut self,
        now_ns: i64,
        autopilot: &mut Autopilot,
        report: &impl Fn(String),
    ) -> Result<(), Box<dyn Error>> {
        let Some(since_ns) = self.since_ns else {
            let progress = self.takeoff.step(now_ns, autopilot);
            match &progress {
                TakeoffProgress::Done => self.since_ns = Some(now_ns),
                TakeoffProgress::Failed(error) => return Err(error.clone().into()),
                _ => {}
            }
            let text = progress.to_string();
            if text != self.progress {
                report(text.clone());
                self.progress = text;
            }
            return Ok(());
        };
        match now_ns.saturating_sub(since_ns) / SECOND {
            seconds @ 0..8 => {
                let north_m_s = if seconds < 5 { 0.5 } else { 0.0 };
                autopilot.set_velocity(now_ns, Vector::new(north_m_s, 0.0, 0.0), 0.0)?;
            }
            _ if self.lands => {}
            _ => {
                autopilot.request(now_ns, Command::SetMode(FlightMode::Land));
                self.lands = true;
            }
        }
        Ok(())
    }
}
