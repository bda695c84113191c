//! The result row of a flight with faults: its touches of the ground with their speeds, how it ended, and
//! whether it was faster than the bar allows.

use serde::Serialize;

use super::plan::Planned;
use crate::landing::outcome::{MAX_HOP_M, MAX_SINK_M_S, MAX_SLIDE_M_S, greater, is_too_fast};

/// How it ended.
#[derive(Copy, Clone, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Ending {
    /// On the ground, motors off.
    Landed,
    /// On the ground, motors on.
    Grounded,
    /// At rest in the air, in a terminal phase or without a controller.
    Hovers,
    /// None of these before the end of the simulation.
    Unfinished,
}

/// The row of one flight, in files with the names and the order of a landing's.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Outcome {
    /// Its seed.
    pub seed: u64,
    /// The kinds of its faults.
    pub kinds: String,
    /// Height over the pad at which they began, in metres.
    pub height_m: f64,
    /// Duration of each, in seconds; empty is for ever.
    pub for_s: Vec<Option<f64>>,
    /// Mean wind, in m/s.
    pub wind_m_s: f64,
    /// The guidance, the marker where one was requested, and the further settings.
    pub settings: String,
    /// The version of the program that flew it.
    pub program: String,
    /// True when the height was reached.
    pub began: bool,
    /// How it ended.
    pub ending: Ending,
    /// The controller's last phase.
    pub phase: String,
    /// Its last reason.
    pub why: String,
    /// True when the controller's phase is terminal, or there is no controller.
    pub is_over: bool,
    /// Number of touches of the ground.
    pub touches: u32,
    /// Greatest downward speed at a touch, in m/s.
    #[serde(rename = "touchdown_speed_m_s")]
    pub sink_m_s: Option<f64>,
    /// Greatest horizontal speed at a touch, in m/s.
    #[serde(rename = "touchdown_lateral_speed_m_s")]
    pub slide_m_s: Option<f64>,
    /// Horizontal distance from the pad at the last touch, in metres.
    #[serde(rename = "touchdown_error_m")]
    pub error_m: Option<f64>,
    /// Greatest height over the position of the first touch, after it, in metres.
    pub hop_m: Option<f64>,
    /// Greatest tilt in flight, in degrees.
    pub max_tilt_deg: f64,
    /// Time from the start of the landing to its end, in seconds.
    pub time_s: f64,
    /// The command that repeats it.
    pub command: String,
}

impl Outcome {
    /// The outcome before the flight.
    pub fn new(planned: &Planned) -> Self {
        let for_s = planned.faults.iter().map(|f| Some(f.for_s).filter(|s| s.is_finite()));
        Self {
            seed: planned.seed,
            kinds: planned.kinds(),
            height_m: planned.height_m,
            for_s: for_s.collect(),
            wind_m_s: planned.wind_m_s,
            settings: planned.settings(),
            program: node::version().to_owned(),
            began: false,
            ending: Ending::Unfinished,
            phase: String::new(),
            why: String::new(),
            is_over: false,
            touches: 0,
            sink_m_s: None,
            slide_m_s: None,
            error_m: None,
            hop_m: None,
            max_tilt_deg: 0.0,
            time_s: 0.0,
            command: planned.command(),
        }
    }

    /// Notes a touch of the ground with these speeds in m/s, this far from the pad in metres.
    pub fn touch(&mut self, sink_m_s: f64, slide_m_s: f64, error_m: f64) {
        self.touches += 1;
        self.sink_m_s = greater(self.sink_m_s, Some(sink_m_s));
        self.slide_m_s = greater(self.slide_m_s, Some(slide_m_s));
        self.error_m = Some(error_m);
    }

    /// Notes the height over the position of the first touch in metres.
    pub fn hop(&mut self, height_m: f64) {
        self.hop_m = greater(self.hop_m, Some(height_m));
    }

    /// True when it stood on the ground and flew again.
    pub fn has_left_ground(&self) -> bool {
        self.hop_m.is_some_and(|hop_m| hop_m > MAX_HOP_M)
    }

    /// True when it touched the ground faster than the bar allows.
    pub fn is_unsafe(&self) -> bool {
        is_too_fast(self.sink_m_s, self.slide_m_s)
    }

    /// How near it came to the bar: above 1 it is unsafe. A flight without a touch has 0.
    pub fn badness(&self) -> f64 {
        let part = |value: Option<f64>, limit: f64| value.map_or(0.0, |value| value / limit);
        part(self.sink_m_s, MAX_SINK_M_S).max(part(self.slide_m_s, MAX_SLIDE_M_S))
    }

    /// True when it neither came to rest nor to a terminal phase.
    pub fn is_unended(&self) -> bool {
        self.ending == Ending::Unfinished || !self.is_over
    }
}
