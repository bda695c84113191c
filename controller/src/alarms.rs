//! Alarms of a landing: a low or critical battery, raised once, and silence of the operator or of the autopilot's link, raised
//! once for each silence; and why a battery is too empty for a flight.

use autopilot::{Battery, without_standstill};
use landing::Alarm;

use crate::config::AlarmSettings;

/// Raises each alarm once in a landing.
#[derive(Clone, Debug)]
pub struct Alarms {
    settings: AlarmSettings,
    low_since_ns: Option<i64>,
    critical_since_ns: Option<i64>,
    operator_ns: Option<i64>,
    autopilot_ns: Option<i64>,
    raised: Vec<Alarm>,
    /// Those that could not be acted on when they were raised first.
    postponed: Vec<Alarm>,
}

impl Alarms {
    /// No alarm was raised, and nothing was received.
    pub fn new(settings: AlarmSettings) -> Self {
        Self {
            settings,
            low_since_ns: None,
            critical_since_ns: None,
            operator_ns: None,
            autopilot_ns: None,
            raised: Vec::new(),
            postponed: Vec::new(),
        }
    }

    /// A landing begins: every alarm may be raised again, and a battery is low once it was so for long in this landing.
    pub fn begin(&mut self) {
        self.raised.clear();
        self.postponed.clear();
        (self.low_since_ns, self.critical_since_ns) = (None, None);
    }

    /// An alarm that was just raised cannot be acted on now: it is raised again with the next tick.
    pub fn postpone(&mut self, alarm: Alarm) {
        self.raised.retain(|raised| *raised != alarm);
        if !self.is_postponed(alarm) {
            self.postponed.push(alarm);
        }
    }

    /// Whether an alarm was raised before, and could not be acted on.
    pub fn is_postponed(&self, alarm: Alarm) -> bool {
        self.postponed.contains(&alarm)
    }

    /// A command or a heartbeat of the ground station was received.
    pub fn operator_active(&mut self, now_ns: i64) {
        self.operator_ns = Some(now_ns);
        // Lost again after this, it is raised again.
        self.raised.retain(|alarm| *alarm != Alarm::OperatorLost);
    }

    /// A state of the autopilot was received.
    pub fn autopilot_active(&mut self, now_ns: i64) {
        self.autopilot_ns = Some(now_ns);
        self.raised.retain(|alarm| *alarm != Alarm::AutopilotLost);
    }

    /// This process has not run for so long: operator, autopilot and battery were not observed in that time.
    pub fn stood_still(&mut self, now_ns: i64, stood_ns: i64) {
        let times = [
            &mut self.low_since_ns,
            &mut self.critical_since_ns,
            &mut self.operator_ns,
            &mut self.autopilot_ns,
        ];
        for at_ns in times.into_iter().flatten() {
            *at_ns = without_standstill(*at_ns, now_ns, stood_ns);
        }
    }

    /// The most severe alarm that is to be raised now.
    pub fn tick(&mut self, now_ns: i64, battery: Option<&Battery>) -> Option<Alarm> {
        let s = &self.settings;
        let is_at = |charge: f64, volts: f64| {
            battery
                .is_some_and(|it| charge_at(it, charge).is_some() || volts_at(it, volts).is_some())
        };
        let low = is_at(s.battery_low, s.battery_low_v);
        let critical = is_at(s.battery_critical, s.battery_critical_v);
        since(&mut self.low_since_ns, low, now_ns);
        since(&mut self.critical_since_ns, critical, now_ns);
        // A battery that is low again is another matter.
        self.postponed.retain(|alarm| match alarm {
            Alarm::BatteryLow => low,
            Alarm::BatteryCritical => critical,
            Alarm::OperatorLost | Alarm::AutopilotLost => true,
        });
        let persists = |from: Option<i64>, limit_s: f64| {
            from.is_some_and(|from| now_ns.saturating_sub(from) as f64 * 1e-9 >= limit_s)
        };
        let checks_operator = s.operator_lost_s > 0.0;
        let checks_autopilot = s.autopilot_lost_s > 0.0;
        let due = [
            (
                Alarm::AutopilotLost,
                checks_autopilot && persists(self.autopilot_ns, s.autopilot_lost_s),
            ),
            (Alarm::BatteryCritical, persists(self.critical_since_ns, s.battery_s)),
            (Alarm::BatteryLow, persists(self.low_since_ns, s.battery_s)),
            (Alarm::OperatorLost, checks_operator && persists(self.operator_ns, s.operator_lost_s)),
        ];
        let new = |(alarm, due): &(Alarm, bool)| *due && !self.raised.contains(alarm);
        let (alarm, _) = due.into_iter().find(new)?;
        self.raised.push(alarm);
        Some(alarm)
    }
}

/// Why no flight begins with this battery: it is at its critical limit or below, so that the vehicle would land at once. An alarm
/// waits, as the voltage drops in a climb; before it motors take nothing.
pub fn too_empty(settings: &AlarmSettings, battery: &Battery) -> Option<String> {
    let AlarmSettings { battery_critical, battery_critical_v, .. } = *settings;
    if let Some(volts) = volts_at(battery, battery_critical_v) {
        return Some(format!(
            "no takeoff: the battery has {volts:.1} V, and is critical at {battery_critical_v} V and below (`alarms.battery_critical_v`); charge it, or correct the limit, and start the controller again"
        ));
    }
    let charge = charge_at(battery, battery_critical)?;
    Some(format!(
        "no takeoff: the battery has {:.0} % of its charge, and is critical at {:.0} % and below (`alarms.battery_critical`); charge it, or correct the limit, and start the controller again",
        100.0 * charge,
        100.0 * battery_critical
    ))
}

/// The charge, where it is at a limit or below; a limit of 0 is none.
fn charge_at(battery: &Battery, limit: f64) -> Option<f64> {
    battery.remaining.filter(|charge| limit > 0.0 && *charge <= limit)
}

/// The same of the voltage in V; an autopilot without a sensor reports 0 V.
fn volts_at(battery: &Battery, limit_v: f64) -> Option<f64> {
    battery.voltage_v.filter(|volts| *volts > 0.0 && *volts <= limit_v)
}

/// Keeps since when a condition has held.
fn since(since_ns: &mut Option<i64>, holds: bool, now_ns: i64) {
    *since_ns = if holds { since_ns.or(Some(now_ns)) } else { None };
}

#[cfg(test)]
mod tests {
    use super::*;

    const SECOND: i64 = 1_000_000_000;

    fn alarms() -> Alarms {
        Alarms::new(AlarmSettings {
            battery_low: 0.2,
            battery_critical: 0.1,
            battery_low_v: 0.0,
            battery_critical_v: 10.5,
            battery_s: 3.0,
            operator_lost_s: 5.0,
            autopilot_lost_s: 1.0,
        })
    }

    fn battery(remaining: f64, voltage_v: f64) -> Battery {
        Battery { remaining: Some(remaining), voltage_v: Some(voltage_v), current_a: None }
    }

    #[test]
    fn a_battery_that_stays_low_raises_one_alarm_and_a_dip_none() {
        let mut alarms = alarms();
        let mut raised = Vec::new();
        for second in 0..60 {
            let battery = match second {
                0..10 => battery(0.5, 12.0),
                10..12 => battery(0.15, 12.0),
                12..20 => battery(0.5, 12.0),
                20..30 => battery(0.15, 12.0),
                _ => battery(0.15, 10.0),
            };
            raised
                .extend(alarms.tick(second * SECOND, Some(&battery)).map(|alarm| (second, alarm)));
        }
        assert_eq!(raised, [(23, Alarm::BatteryLow), (33, Alarm::BatteryCritical)]);
        // At the limit, and no more than once.
        alarms.begin();
        let mut again = Vec::new();
        for second in 600..610 {
            let alarm = alarms.tick(second * SECOND, Some(&battery(0.2, 12.0)));
            again.extend(alarm.map(|alarm| (second, alarm)));
        }
        assert_eq!(again, [(603, Alarm::BatteryLow)], "a dip begins again with the next landing");
    }

    #[test]
    fn only_a_known_operator_is_lost() {
        let mut alarms = alarms();
        assert_eq!(alarms.tick(100 * SECOND, None), None);
        alarms.operator_active(100 * SECOND);
        assert_eq!(alarms.tick(104 * SECOND, None), None);
        assert_eq!(alarms.tick(105 * SECOND, None), Some(Alarm::OperatorLost));
        assert_eq!(alarms.tick(106 * SECOND, None), None, "once");
        alarms.operator_active(107 * SECOND);
        assert_eq!(alarms.tick(112 * SECOND, None), Some(Alarm::OperatorLost), "lost again");
    }

    #[test]
    fn a_silent_autopilot_raises_one_alarm_per_silence() {
        let mut alarms = alarms();
        assert_eq!(alarms.tick(100 * SECOND, None), None);
        for lost_s in [101, 111] {
            alarms.autopilot_active((lost_s - 1) * SECOND);
            assert_eq!(alarms.tick(lost_s * SECOND - 1, None), None);
            assert_eq!(alarms.tick(lost_s * SECOND, None), Some(Alarm::AutopilotLost));
            assert_eq!(alarms.tick((lost_s + 1) * SECOND, None), None, "once");
        }
    }

    #[test]
    fn an_alarm_that_was_postponed_is_raised_again_until_it_is_acted_on() {
        let mut alarms = alarms();
        let critical = battery(0.05, 12.0);
        let mut raise = |second: i64| alarms.tick(second * SECOND, Some(&critical));
        assert_eq!((raise(0), raise(3)), (None, Some(Alarm::BatteryCritical)));
        assert!(!alarms.is_postponed(Alarm::BatteryCritical));
        alarms.postpone(Alarm::BatteryCritical);
        assert_eq!(alarms.tick(4 * SECOND, Some(&critical)), Some(Alarm::BatteryCritical));
        assert!(alarms.is_postponed(Alarm::BatteryCritical));
        alarms.postpone(Alarm::BatteryCritical);
        // A battery that has recovered raises none.
        assert_eq!(alarms.tick(5 * SECOND, Some(&battery(0.5, 12.0))), None);
        // Empty again, it raises a new one, which is logged.
        assert_eq!(alarms.tick(6 * SECOND, Some(&critical)), None);
        assert_eq!(alarms.tick(9 * SECOND, Some(&critical)), Some(Alarm::BatteryCritical));
        assert!(!alarms.is_postponed(Alarm::BatteryCritical));
    }

    #[test]
    fn a_standstill_of_this_process_does_not_count() {
        let mut alarms = alarms();
        let low = battery(0.15, 12.0);
        alarms.operator_active(100 * SECOND);
        alarms.autopilot_active(103 * SECOND);
        assert_eq!(alarms.tick(103 * SECOND, Some(&low)), None);
        alarms.stood_still(109 * SECOND, 6 * SECOND);
        assert_eq!(alarms.tick(109 * SECOND, Some(&low)), None);
        assert_eq!(alarms.tick(110 * SECOND, Some(&low)), Some(Alarm::AutopilotLost));
        assert_eq!(alarms.tick(111 * SECOND, Some(&low)), Some(Alarm::OperatorLost));
        assert_eq!(alarms.tick(112 * SECOND, Some(&low)), Some(Alarm::BatteryLow));
        // A message that was read before the standstill is noticed.
        alarms.operator_active(120 * SECOND);
        alarms.stood_still(120 * SECOND, 6 * SECOND);
        assert_eq!(alarms.tick(125 * SECOND, None), Some(Alarm::OperatorLost));
    }

    #[test]
    fn a_battery_at_its_critical_limit_is_too_empty_to_begin_with() {
        let settings = alarms().settings;
        let why = |battery| too_empty(&settings, &battery);
        assert_eq!(why(battery(0.11, 10.6)), None);
        let text = why(battery(0.5, 10.5)).unwrap();
        assert!(text.contains("10.5 V") && text.contains("battery_critical_v"), "{text}");
        let text = why(battery(0.1, 12.0)).unwrap();
        assert!(text.contains("10 %") && text.contains("`alarms.battery_critical`"), "{text}");
        assert_eq!(why(battery(0.5, 0.0)), None);
        let off = AlarmSettings { battery_critical: 0.0, battery_critical_v: 0.0, ..settings };
        assert_eq!(too_empty(&off, &battery(0.0, 1.0)), None);
        assert_eq!(why(Battery::default()), None);
    }

    #[test]
    fn unknown_values_raise_no_alarm() {
        let unknown = Battery::default();
        assert_eq!(alarms().tick(0, Some(&unknown)), None);
        assert_eq!(alarms().tick(0, None), None);
    }
}
