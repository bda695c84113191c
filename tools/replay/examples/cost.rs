//! Measures the cost of the tape for a flight: the events of a flight with a fault, handled with a tape and without.
//!
//! With `with` or `without` and a number it only handles them so, so many times, for a profiler that counts instructions: of
//! two numbers the difference is that of the flights alone.

#![expect(clippy::print_stdout, reason = "figures are for people to read")]

use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::Context;
use autopilot::Packet;
use controller::flight::Flight;
use controller::tape::TapedFlight;
use experiments::faults::flight::fly_with_tape;
use experiments::faults::kind::Kind;
use experiments::faults::plan::{Plan, Second};
use messages::{CameraInfo, Detections, Tape, TapeEvent};

/// How often each is measured; the quickest counts.
const TIMES: usize = 100;
/// Events after which the tape is taken, about as often as the service does.
const TAKEN_EVERY: usize = 15;

enum Input {
    Packet(Packet),
    Tick,
    Detections(String, Detections),
    Camera(CameraInfo),
    Presence(String, bool),
}

/// Has a flight handle an input; with a tape or without it has the same functions.
macro_rules! handle {
    ($flight:ident, $now_ns:expr, $input:expr) => {
        match $input {
            Input::Packet(packet) => $flight.packet($now_ns, packet),
            Input::Tick => $flight.tick($now_ns),
            Input::Detections(publisher, message) => {
                $flight.detections($now_ns, publisher, message);
            }
            Input::Camera(info) => $flight.camera($now_ns, info.clone()),
            Input::Presence(detector, alive) => $flight.presence($now_ns, detector, *alive),
        }
        while $flight.poll_outgoing().is_some() {}
    };
}

fn main() -> anyhow::Result<()> {
    let plan = Plan {
        flights: 1,
        kinds: vec![Kind::CameraKilled],
        second: Second::None,
        winds_m_s: vec![5.0],
        durations_s: vec![2.0],
        ..Plan::default()
    };
    let flights = plan.flights();
    let (_, tapes) = fly_with_tape(flights.first().context("a flight")?)?;
    let (configuration, inputs) = inputs(&tapes)?;
    let config = || {
        let text = configuration.as_str();
        Ok::<_, anyhow::Error>(
            node::from_toml::<controller::Config>("the tape", text, &[])?.settings,
        )
    };
    let mut args = std::env::args().skip(1);
    let (only, times) = (args.next(), args.next().map_or(Ok(TIMES), |text| text.parse())?);
    let (mut without, mut with) = (Duration::MAX, Duration::MAX);
    for _ in 0..times {
        let mut flight = Flight::new(config()?, Arc::default())?;
        let began = Instant::now();
        for (now_ns, input) in inputs.iter().filter(|_| only.as_deref() != Some("with")) {
            handle!(flight, *now_ns, input);
        }
        without = without.min(began.elapsed());
        let mut flight = TapedFlight::new(0, config()?, Arc::default())?;
        let began = Instant::now();
        let taped = inputs.iter().filter(|_| only.as_deref() != Some("without"));
        for (number, (now_ns, input)) in taped.enumerate() {
            handle!(flight, *now_ns, input);
            if number % TAKEN_EVERY == 0 {
                flight.take_tape();
            }
        }
        with = with.min(began.elapsed());
    }
    if let Some(only) = only {
        println!("{} events, {times} times, {only} a tape", inputs.len());
        return Ok(());
    }
    let events = inputs.len() as f64;
    let (without_us, with_us) = (without.as_secs_f64() * 1e6, with.as_secs_f64() * 1e6);
    let bytes: usize = tapes.iter().map(|tape| tape.records.len()).sum();
    println!("{} events, {} bytes of tape an event", inputs.len(), bytes as f64 / events);
    println!(
        "{:.2} us an event without a tape, {:.2} us with one: {:+.1} %",
        without_us / events,
        with_us / events,
        100.0 * (with_us / without_us - 1.0)
    );
    Ok(())
}

/// The configuration of a tape, and its events with their times in nanoseconds.
fn inputs(tapes: &[Tape]) -> anyhow::Result<(String, Vec<(i64, Input)>)> {
    let mut configuration = String::new();
    let mut inputs = Vec::new();
    for record in tapes.iter().flat_map(Tape::records) {
        let record = record?;
        let input = match record.event {
            TapeEvent::Begin { configuration: text, .. } => {
                configuration = text.into_owned();
                continue;
            }
            TapeEvent::State(_) => continue,
            TapeEvent::Packet { raw } => Input::Packet(Packet::from_raw(&raw).context("a packet")?),
            TapeEvent::Tick => Input::Tick,
            TapeEvent::Detections { publisher, message } => {
                Input::Detections(publisher.into_owned(), message.into_owned())
            }
            TapeEvent::Camera(info) => Input::Camera(info.into_owned()),
            TapeEvent::Presence { detector, alive } => {
                Input::Presence(detector.into_owned(), alive)
            }
            other => anyhow::bail!("a {} is not expected here", other.name()),
        };
        inputs.push((record.now_ns, input));
    }
    Ok((configuration, inputs))
}
