//! Writes a flight as a recording, as a recorder next to the services would: their messages, and the
//! controller's tape.

use std::collections::BTreeMap;
use std::io::Write;

use controller::flight::Flight;
use controller::tape::TapedFlight;
use flightlog::{About, Received, Writer};
use messages::{
    CameraInfo, Configuration, Detections, MavlinkBytes, Message, Topic, Touchdown, Truth, Wind,
    encode, topic,
};
use world::World;

use super::outcome::Outcome;
use super::plan::Planned;
use super::sim_vision::DETECTOR;

/// Period of the controller's status while its phase stays, in nanoseconds.
const STATUS_PERIOD_NS: i64 = 200_000_000;
/// Of this number of ticks one writes the vehicle's state, truth and wind.
const TICKS_PER_STATE: u64 = 2;

/// A recording under way.
pub(crate) struct Recording<'a> {
    writer: Writer<Box<dyn Write + 'a>>,
    ticks: u64,
    status_ns: i64,
    phase: Option<messages::Phase>,
    started_ns: Option<i64>,
}

impl<'a> Recording<'a> {
    /// Begins the recording of a flight.
    pub(crate) fn begin(output: Box<dyn Write + 'a>, planned: &Planned) -> anyhow::Result<Self> {
        let about = About {
            program: controller::tape::program(),
            facts: BTreeMap::from([("command".to_owned(), planned.command())]),
            utc_offset_ns: 0,
        };
        Ok(Self {
            writer: Writer::new(output, &about)?,
            ticks: 0,
            status_ns: i64::MIN,
            phase: None,
            started_ns: None,
        })
    }

    /// The messages of services at their start.
    pub(crate) fn started(
        &mut self,
        now_ns: i64,
        configurations: &BTreeMap<&str, String>,
        camera: &CameraInfo,
    ) -> anyhow::Result<()> {
        for (service, toml) in configurations {
            let configuration = Configuration {
                service: (*service).to_owned(),
                instance: "main".to_owned(),
                host: node::host_name(),
                version: node::version().to_owned(),
                toml: toml.clone(),
            };
            self.write(now_ns, topic::CONFIGURATION, &[service, "main"], &configuration)?;
        }
        self.write(now_ns, topic::CAMERA_INFO, &[&camera.camera], camera)
    }

    /// Detections that arrived; `is_used` when the estimate is published after them.
    pub(crate) fn detections(
        &mut self,
        now_ns: i64,
        message: &Detections,
        flight: &Flight,
        is_used: bool,
    ) -> anyhow::Result<()> {
        self.write(now_ns, topic::DETECTIONS, &[DETECTOR], message)?;
        if is_used {
            self.write(now_ns, topic::TARGET, &[], &flight.target(now_ns))?;
        }
        Ok(())
    }

    /// A packet of the autopilot.
    pub(crate) fn packet(&mut self, now_ns: i64, packet: &[u8]) -> anyhow::Result<()> {
        let bytes = MavlinkBytes { packet: packet.to_vec() };
        self.write(now_ns, topic::FROM_AUTOPILOT, &[], &bytes)
    }

    /// The messages of each tick.
    pub(crate) fn tick(
        &mut self,
        now_ns: i64,
        flight: &mut TapedFlight,
        world: &World,
        outcome: &Outcome,
    ) -> anyhow::Result<()> {
        self.ticks += 1;
        let status = flight.flight().status(now_ns);
        self.started_ns = self.started_ns.or(status.started_ns);
        let is_due = now_ns.saturating_sub(self.status_ns) >= STATUS_PERIOD_NS;
        if is_due || self.phase != Some(status.phase) {
            (self.status_ns, self.phase) = (now_ns, Some(status.phase));
            self.write(now_ns, topic::STATUS, &[], &status)?;
        }
        if self.ticks.is_multiple_of(TICKS_PER_STATE) {
            if let Some(vehicle) = flight.flight().vehicle() {
                self.write(now_ns, topic::VEHICLE_STATE, &[], &vehicle)?;
            }
            let truth = self.truth(now_ns, world, outcome);
            self.write(now_ns, topic::TRUTH, &[], &truth)?;
            let velocity_ned_m_s = world.wind().coords.into();
            let wind = Wind { stamp_ns: now_ns, velocity_ned_m_s };
            self.write(now_ns, topic::WIND, &[], &wind)?;
            if let Some(tape) = flight.take_tape() {
                self.write(now_ns, topic::TAPE, &[], &tape)?;
            }
        }
        Ok(())
    }

    /// Ends it, after the controller's own end.
    pub(crate) fn end(mut self, now_ns: i64, flight: &mut TapedFlight) -> anyhow::Result<()> {
        flight.shutdown(now_ns);
        if let Some(tape) = flight.take_tape() {
            self.write(now_ns, topic::TAPE, &[], &tape)?;
        }
        Ok(self.writer.finish()?)
    }

    fn truth(&self, now_ns: i64, world: &World, outcome: &Outcome) -> Truth {
        let (vehicle, pad) = (world.truth(), world.pad_at(world.now_s()));
        let since_start = |time_s: f64| {
            let started_ns = self.started_ns.unwrap_or_default();
            started_ns.saturating_add((time_s * 1e9) as i64)
        };
        let touchdown = || {
            Some(Touchdown {
                stamp_ns: since_start(outcome.touchdown_s?),
                error_m: outcome.error_m?,
                vertical_speed_m_s: outcome.sink_m_s?,
                lateral_speed_m_s: outcome.slide_m_s?,
            })
        };
        Truth {
            stamp_ns: now_ns,
            ned_from_body_wxyz: vehicle.ned_from_body.wxyz(),
            position_ned_m: vehicle.position.coords.coords.into(),
            velocity_ned_m_s: vehicle.velocity.coords.into(),
            pad_ned_m: pad.position.coords.coords.into(),
            on_ground: vehicle.on_ground,
            touchdown: touchdown(),
            max_tilt_rad: outcome.max_tilt_deg.to_radians(),
            frames: outcome.frames,
        }
    }

    fn write<M: Message>(
        &mut self,
        now_ns: i64,
        topic: Topic<M>,
        names: &[&str],
        message: &M,
    ) -> anyhow::Result<()> {
        let (key, payload) = (topic.key(names), encode(message));
        let received =
            Received { key: &key, payload: &payload, attachment: b"", received_ns: now_ns };
        Ok(self.writer.receive(received)?)
    }
}
