//! The autopilot's setpoint timeout: shortened for a landing and put back, also after a crash.

#![allow(clippy::unwrap_used, reason = "helpers of tests may fail like tests")]

mod packets;

use std::sync::Arc;

use autopilot::Parser;
use autopilot::dialect::{MavLandedState, MavMessage, MavParamType, PARAM_VALUE_DATA};
use controller::Config;
use controller::flight::Flight;
use controller::limits::Note;
use messages::ControllerCommand;
use node::Layers;
use packets::{MS, attitude, contact, heartbeat, position};

const GUIDED: u32 = 4;
const LOITER: u32 = 5;

/// A flight and an autopilot with one parameter.
struct Conversation {
    flight: Flight,
    /// The autopilot's GUID_TIMEOUT, in seconds.
    timeout_s: f32,
    /// It refuses to change the parameter.
    refuses: bool,
    /// Its reports of the parameter are lost.
    is_mute: bool,
    /// The values to which the parameter was set.
    set_s: Vec<f32>,
    /// The downward velocities of all setpoints, in m/s.
    down_m_s: Vec<f32>,
    now_ns: i64,
}

impl Conversation {
    fn new(start: &str, timeout_s: f32) -> Self {
        Self::with(&[&format!("start={start}")], timeout_s)
    }

    fn with(set: &[&str], timeout_s: f32) -> Self {
        // Pinned, it need not listen for other vehicles.
        let set = ["autopilot.system_id=1"].iter().chain(set).map(|&it| it.to_owned()).collect();
        let layers = Layers { file: None, set };
        let config = layers.load::<Config>().unwrap().settings;
        Self {
            flight: Flight::new(config, Arc::default()).unwrap(),
            timeout_s,
            refuses: false,
            is_mute: false,
            set_s: Vec::new(),
            down_m_s: Vec::new(),
            now_ns: 0,
        }
    }

    fn receive(&mut self, message: &MavMessage) {
        packets::receive(&mut self.flight, self.now_ns, message);
    }

    /// Hovers 5 m over the ground in a mode for some seconds.
    fn fly(&mut self, seconds: i64, mode: u32) {
        for step in 0..seconds * 40 {
            self.now_ns += 25 * MS;
            if step % 20 == 0 {
                self.receive(&heartbeat(mode, true));
                self.receive(&contact(MavLandedState::MAV_LANDED_STATE_IN_AIR));
            }
            self.receive(&attitude(self.now_ns));
            self.receive(&position(self.now_ns, 5.0));
            self.flight.tick(self.now_ns);
            self.answer();
        }
    }

    /// The autopilot handles the packets that were sent to it.
    fn answer(&mut self) {
        let mut reports = false;
        while let Some(packet) = self.flight.poll_outgoing() {
            for packet in Parser::new().push(&packet) {
                match packet.message {
                    Some(MavMessage::PARAM_SET(set)) => {
                        assert_eq!(set.param_id.to_str(), Ok("GUID_TIMEOUT"));
                        self.set_s.push(set.param_value);
                        if !self.refuses {
                            self.timeout_s = set.param_value;
                        }
                        reports = true;
                    }
                    Some(MavMessage::PARAM_REQUEST_READ(request)) => {
                        reports |= request.param_id.to_str() == Ok("GUID_TIMEOUT");
                    }
                    Some(MavMessage::SET_POSITION_TARGET_LOCAL_NED(setpoint)) => {
                        self.down_m_s.push(setpoint.vz);
                    }
                    _ => {}
                }
            }
        }
        if reports && !self.is_mute {
            self.receive(&MavMessage::PARAM_VALUE(PARAM_VALUE_DATA {
                param_value: self.timeout_s,
                param_id: "GUID_TIMEOUT".into(),
                param_type: MavParamType::MAV_PARAM_TYPE_REAL32,
                ..Default::default()
            }));
        }
    }

    fn shown_s(&self) -> Option<f64> {
        self.flight.status(self.now_ns).setpoint_timeout_s
    }
}

#[test]
fn the_timeout_is_shortened_for_a_landing_and_put_back() {
    let mut it = Conversation::new("airborne", 3.0);
    it.fly(3, GUIDED);
    assert_eq!((it.timeout_s, it.shown_s()), (0.5, Some(0.5)));
    assert_eq!(it.flight.note().map(|note| note.original_s), Some(3.0));
    // The pilot takes over.
    it.fly(4, LOITER);
    assert_eq!((it.timeout_s, it.shown_s()), (3.0, Some(3.0)));
    assert_eq!(it.set_s, [0.5, 3.0]);
    assert_eq!(it.flight.note(), None);
}

#[test]
fn a_shorter_timeout_stays() {
    let mut it = Conversation::new("airborne", 0.3);
    it.fly(3, GUIDED);
    it.fly(4, LOITER);
    assert_eq!((it.timeout_s, it.set_s), (0.3, vec![]));
}

#[test]
fn an_autopilot_that_refuses_is_asked_a_few_times_only() {
    let mut it = Conversation::new("airborne", 3.0);
    it.refuses = true;
    it.fly(8, GUIDED);
    assert!((1..=10).contains(&it.set_s.len()), "{:?}", it.set_s);
    assert_eq!(it.shown_s(), Some(3.0), "the descent takes it into account");
}

#[test]
fn the_parameter_of_a_killed_controller_is_put_back() {
    let mut killed = Conversation::new("airborne", 3.0);
    killed.fly(3, GUIDED);
    let note = killed.flight.note().cloned().unwrap();
    assert_eq!(killed.timeout_s, 0.5);
    // The next one has no landing to resume.
    let mut next = Conversation::new("command", 0.5);
    next.flight.take_over(note.clone());
    next.fly(4, LOITER);
    assert_eq!((next.timeout_s, next.flight.note()), (3.0, None));
    // Or it has one, and puts it back at its end.
    let mut resumed = Conversation::new("resume", 0.5);
    resumed.flight.take_over(note.clone());
    resumed.fly(3, GUIDED);
    assert_eq!((resumed.timeout_s, resumed.set_s.len()), (0.5, 0));
    resumed.fly(4, LOITER);
    assert_eq!(resumed.timeout_s, 3.0);
    // A value that another program chose meanwhile stays, as does that of another vehicle.
    let impossible = Note { original_s: 1e9, ..note.clone() };
    for (timeout_s, note) in
        [(1.0, note.clone()), (0.5, Note { system: 7, ..note }), (0.5, impossible)]
    {
        let mut other = Conversation::new("command", timeout_s);
        other.flight.take_over(note);
        other.fly(4, LOITER);
        assert_eq!((other.timeout_s, other.flight.note()), (timeout_s, None));
    }
}

/// It waits for heartbeats of another vehicle before it resumes the landing.
#[test]
fn a_controller_that_resumes_with_any_vehicle_leaves_the_timeout_short() {
    let mut killed = Conversation::new("airborne", 3.0);
    killed.fly(3, GUIDED);
    let note = killed.flight.note().cloned().unwrap();
    let mut next = Conversation::with(&["start=resume", "autopilot.system_id=0"], 0.5);
    next.flight.take_over(note);
    next.fly(6, GUIDED);
    assert!(next.flight.status(next.now_ns).started_ns.is_some());
    assert_eq!((next.timeout_s, next.set_s.as_slice()), (0.5, [].as_slice()));
    next.fly(4, LOITER);
    assert_eq!((next.timeout_s, next.flight.note()), (3.0, None));
}

#[test]
fn an_orderly_end_puts_it_back_at_once_and_sends_no_descent() {
    let mut it = Conversation::new("airborne", 3.0);
    it.fly(3, GUIDED);
    it.down_m_s.clear();
    let mut steps = 0;
    while it.flight.shutdown(it.now_ns) {
        it.now_ns += 25 * MS;
        it.answer();
        it.receive(&attitude(it.now_ns));
        steps += 1;
        assert!(steps < 10);
    }
    assert_eq!((it.timeout_s, it.flight.note()), (3.0, None));
    assert_eq!(it.down_m_s, [0.0]);
}

#[test]
fn a_change_without_its_report_is_put_back_all_the_same() {
    // An orderly end, within a round trip of the change.
    let mut it = Conversation::new("airborne", 3.0);
    it.fly(1, LOITER);
    it.is_mute = true;
    it.fly(1, GUIDED);
    assert_eq!((it.timeout_s, it.shown_s()), (0.5, Some(3.0)));
    for step in 0..400 {
        it.is_mute = step < 200;
        let is_pending = it.flight.shutdown(it.now_ns);
        assert_eq!(is_pending, it.flight.note().is_some(), "the note stays until it is confirmed");
        if !is_pending {
            break;
        }
        it.now_ns += 25 * MS;
        it.answer();
        it.receive(&heartbeat(GUIDED, true));
        it.receive(&attitude(it.now_ns));
    }
    assert_eq!((it.timeout_s, it.flight.note()), (3.0, None));
    // A takeover while all reports are lost.
    let mut it = Conversation::new("airborne", 3.0);
    it.fly(1, LOITER);
    it.is_mute = true;
    it.fly(2, GUIDED);
    it.fly(8, LOITER);
    assert!(it.flight.note().is_some(), "nothing was confirmed");
    it.is_mute = false;
    it.fly(4, LOITER);
    assert_eq!((it.timeout_s, it.flight.note()), (3.0, None));
}

#[test]
fn a_landing_that_begins_while_the_timeout_is_put_back_has_it_shortened_again() {
    let mut it = Conversation::new("command", 3.0);
    let start = |it: &mut Conversation| {
        it.fly(1, GUIDED);
        let reply = it.flight.command(it.now_ns, &ControllerCommand::Start);
        assert!(reply.accepted, "{reply:?}");
        it.fly(2, GUIDED);
    };
    start(&mut it);
    assert_eq!(it.timeout_s, 0.5);
    // The timeout is put back two seconds after the takeover, and all that reports it is lost.
    it.is_mute = true;
    it.fly(3, LOITER);
    assert_eq!((it.timeout_s, it.shown_s()), (3.0, Some(0.5)));
    start(&mut it);
    it.is_mute = false;
    it.fly(2, GUIDED);
    assert_eq!((it.timeout_s, it.shown_s()), (0.5, Some(0.5)));
    assert_eq!(it.flight.note().map(|note| note.original_s), Some(3.0));
    it.fly(4, LOITER);
    assert_eq!((it.timeout_s, it.flight.note()), (3.0, None));
}

#[test]
fn a_value_of_an_earlier_controller_is_not_taken_for_the_vehicles_own() {
    let mut killed = Conversation::new("airborne", 3.0);
    killed.fly(3, GUIDED);
    let note = killed.flight.note().cloned().unwrap();
    let mut next = Conversation::with(&["start=resume", "autopilot.setpoint_timeout_s=0.3"], 0.5);
    next.flight.take_over(note);
    next.fly(3, GUIDED);
    assert_eq!(next.timeout_s, 0.3);
    next.fly(4, LOITER);
    assert_eq!((next.timeout_s, next.flight.note()), (3.0, None));
}

#[test]
fn a_resuming_controller_stops_the_vehicle_with_its_first_packet() {
    for (start, setpoints) in [("resume", vec![0.0]), ("airborne", vec![])] {
        let mut it = Conversation::new(start, 3.0);
        it.receive(&attitude(it.now_ns));
        it.answer();
        assert_eq!(it.down_m_s, setpoints, "{start}");
    }
}
