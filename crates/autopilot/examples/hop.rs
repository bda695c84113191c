//! Takes off, flies a little to the north, and lands again: `cargo run -p autopilot --example hop -- ADDRESS`.
//!
//! It shows a whole flight with this crate; try it on ArduPilot's simulator with `udpin:127.0.0.1:14550`.

#![allow(clippy::print_stdout, reason = "a program for the terminal")]

use std::error::Error;
use std::time::Instant;

use autopilot::{
    Command, Config, Event, FlightMode, Happening, LandedState, Session, Takeoff, TakeoffProgress,
};
use geometry::Vector;

const SECOND: i64 = 1_000_000_000;

#[tokio::main(flavor = "current_thread")]
async fn main() -> Result<(), Box<dyn Error>> {
    let address = std::env::args().nth(1).unwrap_or_else(|| "udpin:127.0.0.1:14550".to_owned());
    let began = Instant::now();
    let clock = move || i64::try_from(began.elapsed().as_nanos()).unwrap_or(i64::MAX);
    let mut session = Session::open(address.parse()?, Config::default(), clock).await?;
    let mut takeoff = Takeoff::new(10.0);
    let mut said = String::new();
    let mut flying_since = None;
    let mut landing = false;
    loop {
        let now_ns = match session.next().await {
            Happening::Tick { now_ns } => now_ns,
            Happening::Packet { .. }
            | Happening::Vehicle(
                Event::Attitude(_) | Event::Position(_) | Event::State(_) | Event::Range(_),
            ) => {
                continue;
            }
            Happening::Vehicle(Event::LandedChanged { to: LandedState::OnGround, .. })
                if landing =>
            {
                println!("{:8.3} landed", began.elapsed().as_secs_f64());
                continue;
            }
            Happening::Vehicle(Event::ArmedChanged(false)) if landing => {
                println!("{:8.3} disarmed: the end", began.elapsed().as_secs_f64());
                return Ok(());
            }
            other => {
                println!("{:8.3} {other:?}", began.elapsed().as_secs_f64());
                continue;
            }
        };
        let Some(since_ns) = flying_since else {
            let progress = session.act(|now_ns, autopilot| takeoff.step(now_ns, autopilot));
            match &progress {
                TakeoffProgress::Done => flying_since = Some(now_ns),
                TakeoffProgress::Failed(error) => return Err(error.clone().into()),
                _ => {}
            }
            let words = progress.to_string();
            if words != said {
                println!("{:8.3} {words}", began.elapsed().as_secs_f64());
                said = words;
            }
            continue;
        };
        let north_m_s = if now_ns - since_ns < 5 * SECOND { 0.5 } else { 0.0 };
        if now_ns - since_ns < 8 * SECOND {
            session.act(|now_ns, autopilot| {
                autopilot.set_velocity(now_ns, Vector::new(north_m_s, 0.0, 0.0), 0.0)
            })?;
        } else if !landing {
            landing = true;
            println!("{:8.3} {:?}", began.elapsed().as_secs_f64(), session.autopilot().state());
            session.act(|now_ns, autopilot| {
                autopilot.request(now_ns, Command::SetMode(FlightMode::Land))
            });
        }
    }
}
