//! The other way to fly: the autopilot's own precision landing, which is told where the landing point is.
//!
//! No setpoint is sent. The landing point goes to the autopilot with every frame that was used; the pilot, a mission or
//! our own start changes to LAND (PRECISION LAND on PX4), and the autopilot does the rest.

use autopilot::{Autopilot, Command, CommandId, CommandStatus, Firmware, FlightMode, Parameter};

use messages::Phase;

use crate::config::LandingTargetSettings;

/// The parameters of ArduPilot that decide whether it listens.
pub const PARAMETERS: [&str; 2] = ["PLND_ENABLED", "PLND_TYPE"];
/// PLND_TYPE of the landing targets that come by MAVLink.
const MAVLINK: f64 = 1.0;
/// ArduPilot begins anew after a longer gap between two landing targets, in nanoseconds.
const LONGEST_GAP_NS: i64 = 500_000_000;

/// A precision landing by the autopilot.
#[derive(Debug)]
pub struct Feed {
    settings: LandingTargetSettings,
    /// For how long it is waited for the marker, in seconds.
    patience_s: f64,
    /// From when to when landing targets were sent without a gap.
    fed: Option<(i64, i64)>,
    part: Part,
}

#[derive(Clone, Debug, PartialEq)]
enum Part {
    /// Nobody has asked for a landing.
    Waits,
    /// The landing was begun at this time, and the autopilot does not know the target for long enough.
    Steadies(i64),
    /// LAND is asked for.
    Asks(CommandId),
    /// The autopilot lands.
    Lands,
    /// It is being taken back from landing.
    Recalls(CommandId, String),
    /// On the ground, disarmed.
    Landed,
    /// It was given up, or somebody took over.
    Ended(String),
}

impl Feed {
    /// Nothing is sent yet; a landing that is begun waits for the marker for so long, in seconds.
    pub fn new(settings: LandingTargetSettings, patience_s: f64) -> Self {
        Self { settings, patience_s, fed: None, part: Part::Waits }
    }

    /// A landing target was sent.
    pub fn sent(&mut self, now_ns: i64) {
        let since_ns = match self.fed {
            Some((since_ns, last_ns)) if now_ns.saturating_sub(last_ns) < LONGEST_GAP_NS => {
                since_ns
            }
            _ => now_ns,
        };
        self.fed = Some((since_ns, now_ns));
    }

    /// Begins a landing: LAND is asked for once the autopilot has known the target for long enough.
    pub fn begin(&mut self, now_ns: i64) {
        self.part = Part::Steadies(now_ns);
    }

    /// Follows what the autopilot does; true when it has just begun to land, by whoever's order.
    pub fn step(&mut self, now_ns: i64, autopilot: &mut Autopilot) -> bool {
        let Some(state) = autopilot.state().copied() else { return false };
        let lands = state.armed && state.mode.is_landing();
        match self.part.clone() {
            Part::Lands if !state.armed => self.part = Part::Landed,
            Part::Lands if !lands => {
                self.part = Part::Ended(format!("the flight mode was changed to {}", state.mode));
            }
            Part::Lands => {}
            Part::Recalls(request, why) => match autopilot.status(request) {
                CommandStatus::Pending => {}
                CommandStatus::Failed(problem) if lands => {
                    tracing::error!(%problem, "The landing could not be taken back");
                    self.part = Part::Lands;
                }
                _ => self.part = Part::Ended(why),
            },
            // By the pilot or a mission, or because it was asked for.
            _ if lands => {
                autopilot.withdraw();
                self.part = Part::Lands;
                return true;
            }
            Part::Steadies(_) | Part::Asks(_) if !state.mode.is_guided() || !state.armed => {
                autopilot.withdraw();
                self.part = Part::Ended(format!("the pilot flies, in {}", state.mode));
            }
            Part::Steadies(since_ns) => self.wait_or_ask(now_ns, since_ns, autopilot),
            Part::Asks(request) => {
                if let CommandStatus::Failed(problem) = autopilot.status(request) {
                    self.part = Part::Ended(problem.to_string());
                }
            }
            Part::Waits | Part::Landed | Part::Ended(_) => {}
        }
        false
    }

    fn wait_or_ask(&mut self, now_ns: i64, since_ns: i64, autopilot: &mut Autopilot) {
        let mode = autopilot.firmware().and_then(Firmware::precision_land);
        let waited_s = now_ns.saturating_sub(since_ns) as f64 * 1e-9;
        if self.is_steady(now_ns)
            && problem(autopilot).is_none()
            && let Some(mode) = mode
        {
            self.part = Part::Asks(autopilot.request(now_ns, Command::SetMode(mode)));
        } else if waited_s > self.patience_s {
            self.part = Part::Ended(problem(autopilot).unwrap_or_else(|| {
                format!("the marker was not seen for {waited_s:.0} s without gaps; it hovers")
            }));
        }
    }

    /// Ends a landing that is under way: one that the autopilot flies already is taken back to the mode in which it
    /// hovers, unless it is lower than `no_return_m`.
    ///
    /// # Errors
    /// Says why not.
    pub fn give_up(
        &mut self,
        now_ns: i64,
        height_m: Option<f64>,
        no_return_m: f64,
        autopilot: &mut Autopilot,
    ) -> Result<String, String> {
        match self.part {
            Part::Steadies(_) | Part::Asks(_) => {
                autopilot.withdraw();
                let why = "given up by the operator; it hovers".to_owned();
                self.part = Part::Ended(why.clone());
                Ok(why)
            }
            Part::Lands if height_m.is_some_and(|height_m| height_m <= no_return_m) => {
                Err(format!(
                    "it is lower than {no_return_m} m, so the autopilot's landing is left to finish"
                ))
            }
            Part::Lands => {
                let hover = match autopilot.firmware() {
                    Some(Firmware::Px4) => FlightMode::AUTO_HOLD,
                    _ => FlightMode::Guided,
                };
                let request = autopilot.request(now_ns, Command::SetMode(hover));
                let why = format!("taken back by the operator, to hover in {hover}");
                self.part = Part::Recalls(request, why.clone());
                Ok(why)
            }
            Part::Waits | Part::Recalls(..) | Part::Landed | Part::Ended(_) => {
                Err(format!("no landing is under way (phase `{}`)", self.phase(now_ns, None).0))
            }
        }
    }

    /// The phase and the reason for it, in words; `problem` is what keeps the autopilot from listening.
    pub fn phase(&self, now_ns: i64, problem: Option<String>) -> (Phase, String) {
        let told = if self.is_fed(now_ns) {
            "the autopilot is told the landing point"
        } else {
            "no landing point to tell the autopilot"
        };
        match &self.part {
            Part::Waits => (
                Phase::Idle,
                problem.unwrap_or_else(|| {
                    format!("waiting for LAND by the pilot, a mission or a start; {told}")
                }),
            ),
            Part::Steadies(_) => (
                Phase::Approach,
                problem.unwrap_or_else(|| {
                    format!("waiting until the autopilot knows the target; {told}")
                }),
            ),
            Part::Asks(_) => (Phase::Final, "asking for LAND".to_owned()),
            Part::Lands => (Phase::Final, format!("the autopilot lands by itself; {told}")),
            Part::Landed => (Phase::Landed, "landed and disarmed".to_owned()),
            Part::Recalls(_, why) | Part::Ended(why) => (Phase::Aborted, why.clone()),
        }
    }

    /// True from the beginning of a landing to its end.
    pub fn is_under_way(&self) -> bool {
        matches!(self.part, Part::Steadies(_) | Part::Asks(_) | Part::Lands)
    }

    /// True once a landing has ended.
    pub fn is_finished(&self) -> bool {
        matches!(self.part, Part::Landed | Part::Ended(_))
    }

    fn is_fed(&self, now_ns: i64) -> bool {
        self.fed.is_some_and(|(_, last_ns)| now_ns.saturating_sub(last_ns) < LONGEST_GAP_NS)
    }

    fn is_steady(&self, now_ns: i64) -> bool {
        let steady_ns = (self.settings.steady_s * 1e9) as i64;
        self.is_fed(now_ns)
            && self.fed.is_some_and(|(since_ns, last_ns)| last_ns - since_ns >= steady_ns)
    }
}

/// What keeps this autopilot from landing on what it is told, and what to do about it.
pub fn problem(autopilot: &Autopilot) -> Option<String> {
    match autopilot.firmware()? {
        // PX4 asks for nothing beforehand: its mode PRECISION LAND listens.
        Firmware::Px4 => return None,
        Firmware::Copter => {}
        other => return Some(format!("{other} has no precision landing that is fed here")),
    }
    match autopilot.parameter("PLND_ENABLED") {
        Parameter::Unknown => return Some("waiting for the parameter PLND_ENABLED".to_owned()),
        Parameter::Silent => {
            return Some(
                "the autopilot does not tell PLND_ENABLED: it was built without precision landing, or does not hear us"
                    .to_owned(),
            );
        }
        Parameter::Value(0.0) => {
            return Some(
                "the autopilot's precision landing is off: set PLND_ENABLED to 1 and PLND_TYPE to 1, and restart it"
                    .to_owned(),
            );
        }
        Parameter::Value(_) => {}
    }
    match autopilot.parameter("PLND_TYPE") {
        Parameter::Unknown => Some("waiting for the parameter PLND_TYPE".to_owned()),
        Parameter::Value(MAVLINK) => None,
        Parameter::Value(other) => Some(format!(
            "the autopilot's precision landing listens to another sensor (PLND_TYPE is {other}): set PLND_TYPE to 1 and restart it"
        )),
        Parameter::Silent => Some(
            "the autopilot does not tell PLND_TYPE: restart it, as PLND_ENABLED shows the others only then"
                .to_owned(),
        ),
    }
}
