//! Gives the messages of a recording present stamps, as those of a flight under way have.

use airlink::Unpacker;
use flightlog::{Received, VehicleClock};
use messages::{
    CameraControl, ControllerStatus, Detections, FrameAck, FrameHeader, Health, Message,
    PixelFormat, Refusals, TargetEstimate, Truth, VehicleState, Wind, decode, encode, topic,
};

/// Moves stamps from the time of a recording to that of its publication.
pub struct Restamp {
    /// Added to stamps of the recorder's clock, in nanoseconds.
    shift_ns: i64,
    /// Name of the clock that they are of then.
    clock: String,
    vehicle_clock: VehicleClock,
    unpacker: Unpacker,
}

impl Restamp {
    /// For a recording whose time `recorded_ns` is `now_ns` of the clock of this name.
    pub fn new(recorded_ns: i64, now_ns: i64, clock: &str) -> Self {
        Self {
            shift_ns: now_ns.saturating_sub(recorded_ns),
            clock: clock.to_owned(),
            vehicle_clock: VehicleClock::default(),
            unpacker: Unpacker::default(),
        }
    }

    /// The same of a recorder whose clock had this name, if that is known.
    pub fn recorded_by(self, clock: Option<&str>) -> Self {
        Self { vehicle_clock: VehicleClock::new(clock), ..self }
    }

    /// A time of the recorder's clock by that of now, in nanoseconds.
    pub fn due_ns(&self, received_ns: i64) -> i64 {
        received_ns.saturating_add(self.shift_ns)
    }

    /// The payload with new stamps; that of a message without any, or which cannot be decoded, as it is.
    pub fn payload(&mut self, message: Received<'_>) -> Vec<u8> {
        let Received { key, payload, .. } = message;
        let is = |pattern: String| pattern == key;
        let stamped = if topic::DETECTIONS.first_name(key).is_some() {
            self.stamped(message, |now, it: &mut Detections| it.header = now.header(&it.header))
        } else if topic::REFUSALS.first_name(key).is_some() {
            self.stamped(message, |now, it: &mut Refusals| it.header = now.header(&it.header))
        } else if topic::FRAME_ACK.first_name(key).is_some() {
            self.stamped(message, |now, it: &mut FrameAck| {
                it.stamp_ns = now.stamp_of(it.stamp_ns, Some(&it.clock));
                now.clock.clone_into(&mut it.clock);
            })
        } else if topic::CAMERA_CONTROL.first_name(key).is_some() {
            self.stamped(message, |now, it: &mut CameraControl| {
                it.stamp_ns = now.stamp_of(it.stamp_ns, Some(&it.clock));
                now.clock.clone_into(&mut it.clock);
            })
        } else if topic::HEALTH.first_name(key).is_some() {
            self.stamped(message, |now, it: &mut Health| {
                now.restamp.vehicle_clock.take_health(it);
                it.stamp_ns = now.stamp_of(it.stamp_ns, Some(&it.clock));
                now.clock.clone_into(&mut it.clock);
            })
        } else if is(topic::VEHICLE_STATE.key(&[])) {
            self.stamped(message, |now, it: &mut VehicleState| {
                it.stamp_ns = now.stamp_ns(it.stamp_ns);
            })
        } else if is(topic::TARGET.key(&[])) {
            self.stamped(message, |now, it: &mut TargetEstimate| {
                it.stamp_ns = now.stamp_ns(it.stamp_ns);
            })
        } else if is(topic::STATUS.key(&[])) {
            self.stamped(message, |now, it: &mut ControllerStatus| {
                // All three by the age of the status: the landing may have begun long before.
                let shift_ns = now.stamp_ns(it.stamp_ns).saturating_sub(it.stamp_ns);
                it.stamp_ns = it.stamp_ns.saturating_add(shift_ns);
                for time_ns in [&mut it.started_ns, &mut it.disarmed_ns].into_iter().flatten() {
                    *time_ns = time_ns.saturating_add(shift_ns);
                }
            })
        } else if is(topic::TRUTH.key(&[])) {
            self.stamped(message, |now, it: &mut Truth| {
                let shift_ns = now.stamp_ns(it.stamp_ns).saturating_sub(it.stamp_ns);
                it.stamp_ns = it.stamp_ns.saturating_add(shift_ns);
                if let Some(touchdown) = &mut it.touchdown {
                    touchdown.stamp_ns = touchdown.stamp_ns.saturating_add(shift_ns);
                }
            })
        } else if is(topic::WIND.key(&[])) {
            self.stamped(message, |now, it: &mut Wind| it.stamp_ns = now.stamp_ns(it.stamp_ns))
        } else {
            None
        };
        stamped.unwrap_or_else(|| payload.to_vec())
    }

    /// A frame with new stamps and its pixels, grey where they were kept as a JPEG file; `None` when that cannot be decoded.
    pub fn frame(
        &mut self,
        header: &FrameHeader,
        bytes: &[u8],
        received_ns: i64,
    ) -> Option<(FrameHeader, Vec<u8>)> {
        let mut header = Now { restamp: self, received_ns }.header(header);
        if header.format != PixelFormat::Jpeg {
            return Some((header, bytes.to_vec()));
        }
        let parts = self.unpacker.unpack(&header, bytes).ok()?;
        let (_, image) = parts.first()?;
        header.format = PixelFormat::Mono8;
        Some((header, image.pixels().to_vec()))
    }

    fn stamped<M: Message>(
        &mut self,
        message: Received<'_>,
        stamp: impl FnOnce(&mut Now<'_>, &mut M),
    ) -> Option<Vec<u8>> {
        let mut decoded: M = decode(message.payload).ok()?;
        let mut now = Now { restamp: self, received_ns: message.received_ns };
        stamp(&mut now, &mut decoded);
        Some(encode(&decoded))
    }
}

/// Moves the stamps of one message.
struct Now<'a> {
    restamp: &'a mut Restamp,
    received_ns: i64,
}

impl std::ops::Deref for Now<'_> {
    type Target = Restamp;
    fn deref(&self) -> &Restamp {
        self.restamp
    }
}

impl Now<'_> {
    /// A stamp of the controller's clock, or of the simulator's.
    fn stamp_ns(&mut self, stamp_ns: i64) -> i64 {
        self.stamp_of(stamp_ns, None)
    }

    fn stamp_of(&mut self, stamp_ns: i64, clock: Option<&str>) -> i64 {
        let ours_ns = self.restamp.vehicle_clock.ours(self.received_ns, stamp_ns, clock);
        self.restamp.due_ns(ours_ns)
    }

    fn header(&mut self, header: &FrameHeader) -> FrameHeader {
        let stamp_ns = self.stamp_of(header.stamp_ns, Some(&header.clock));
        FrameHeader { stamp_ns, clock: self.restamp.clock.clone(), ..header.clone() }
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use messages::{Row, TOPICS, Touchdown};

    use super::*;

    const RECEIVED_NS: i64 = 1_000_000_000_000;

    fn restamp() -> Restamp {
        Restamp::new(RECEIVED_NS, 5_000_000_000_000, "here")
    }

    fn again<M: Message>(restamp: &mut Restamp, key: &str, message: &M) -> M {
        let payload = encode(message);
        let attachment = b"";
        let received_ns = RECEIVED_NS;
        decode(&restamp.payload(Received { key, payload: &payload, attachment, received_ns }))
            .unwrap()
    }

    fn truth(stamp_ns: i64) -> Truth {
        let touchdown = Touchdown {
            stamp_ns: stamp_ns - 3,
            error_m: 0.0,
            vertical_speed_m_s: 0.0,
            lateral_speed_m_s: 0.0,
        };
        Truth { stamp_ns, touchdown: Some(touchdown), ..Truth::sample() }
    }

    #[test]
    fn stamps_keep_their_age_and_get_the_clock_of_now() {
        let mut restamp = restamp();
        let header = FrameHeader { stamp_ns: RECEIVED_NS - 40, ..FrameHeader::sample() };
        let found = Detections { header, ..Detections::sample() };
        let moved = again(&mut restamp, "detector/main/detections", &found);
        assert_eq!(moved.header.stamp_ns, 5_000_000_000_000 - 40);
        assert_eq!(moved.header.clock, "here");
        assert_eq!(moved.detections, found.detections);
        let stamp_ns = RECEIVED_NS - 40;
        let control = CameraControl { stamp_ns, ..CameraControl::default() };
        let moved = again(&mut restamp, "camera/down/control", &control);
        assert_eq!((moved.stamp_ns, moved.clock.as_str()), (5_000_000_000_000 - 40, "here"));
    }

    #[test]
    fn stamps_of_a_vehicle_that_was_started_with_the_ground_are_moved_by_its_clocks_name() {
        let header = |clock: &str| FrameHeader {
            stamp_ns: RECEIVED_NS - 20_000_000_000,
            clock: clock.into(),
            ..FrameHeader::sample()
        };
        let mut restamp = restamp().recorded_by(Some("ground"));
        for (clock, stamp_ns) in [("ground", 4_980_000_000_000), ("drone", 5_000_000_000_000)] {
            let found = Detections { header: header(clock), ..Detections::sample() };
            let moved = again(&mut restamp, "detector/main/detections", &found);
            assert_eq!(moved.header.stamp_ns, stamp_ns, "{clock}");
        }
    }

    #[test]
    fn times_before_a_status_or_a_touchdown_move_with_it() {
        let mut restamp = restamp();
        let started_ns = Some(RECEIVED_NS - 100_000_000_000);
        let status = ControllerStatus {
            stamp_ns: RECEIVED_NS - 7,
            started_ns,
            ..ControllerStatus::default()
        };
        let again_status = again(&mut restamp, "controller/status", &status);
        assert_eq!(again_status.stamp_ns, 5_000_000_000_000 - 7);
        assert_eq!(again_status.started_ns, Some(5_000_000_000_000 - 100_000_000_000));
        // The stamps of a vehicle whose clock restarted: by the age of the first message.
        let again_truth = again(&mut restamp, "truth", &truth(50));
        assert_eq!(again_truth.stamp_ns, 5_000_000_000_000);
        assert_eq!(again_truth.touchdown.unwrap().stamp_ns, 5_000_000_000_000 - 3);
        let again_truth = again(&mut restamp, "truth", &truth(1_050));
        assert_eq!(again_truth.stamp_ns, 5_000_000_001_000);
    }

    #[test]
    fn every_topic_whose_message_has_a_stamp_is_known() {
        // Apart from those that are not published again, and those of bytes and of frames.
        const WITHOUT: [&str; 10] = [
            "CameraInfo",
            "CameraResponse",
            "Configuration",
            "DetectorInfo",
            "FrameHeader",
            "GcsStatus",
            "MavlinkBytes",
            "RecorderStatus",
            "Tape",
            "CommandReply",
        ];
        let known = [
            Detections::NAME,
            Refusals::NAME,
            FrameAck::NAME,
            CameraControl::NAME,
            Health::NAME,
            VehicleState::NAME,
            TargetEstimate::NAME,
            ControllerStatus::NAME,
            Truth::NAME,
            Wind::NAME,
        ];
        let is_command = |row: &&Row| row.delivery == messages::Delivery::Query;
        let named: BTreeSet<&str> =
            TOPICS.iter().filter(|row| !is_command(row)).map(|row| row.message).collect();
        let all: BTreeSet<&str> = known.into_iter().chain(WITHOUT).collect();
        assert!(named.is_subset(&all), "{:?}", named.difference(&all));
    }
}
