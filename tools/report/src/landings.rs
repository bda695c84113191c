//! Finds the landings in a recording, and reduces a flight to one of them.

use std::collections::BTreeMap;
use std::ops::Range;

use crate::flight::{Flight, Landing};

/// The time before a landing's begin that belongs to it, in nanoseconds.
const BEFORE_NS: i64 = 2_000_000_000;

/// When each landing of a flight began, in nanoseconds of the vehicle's clock.
pub fn begins(flight: &Flight) -> Vec<i64> {
    let mut begins: Vec<i64> = flight.statuses.iter().filter_map(|it| it.started_ns).collect();
    begins.sort_unstable();
    begins.dedup();
    begins
}

impl Flight {
    /// The time of the landing as far as it is known, in nanoseconds of the vehicle's clock: from its begin to the status that it is
    /// finished, or else to the last status. `None` without a landing.
    pub fn landing_ns(&self) -> Option<Range<i64>> {
        let begun_ns = self.statuses.iter().find_map(|it| it.started_ns)?;
        let mut of_landing = self.statuses.iter().filter(|it| it.stamp_ns >= begun_ns);
        let finished = of_landing.find(|status| status.finished).or(self.statuses.last());
        Some(begun_ns..finished.map_or(begun_ns, |it| it.stamp_ns).max(begun_ns))
    }

    /// When the landing began, or else the recording, as date and time of UTC by the recorder's machine.
    pub fn begun_utc(&self) -> Option<String> {
        let begun_ns = match self.landing_ns() {
            Some(landing_ns) => landing_ns.start.saturating_add(self.shift_ns),
            None => self.origin.received_ns.as_ref()?.start,
        };
        self.origin.utc(begun_ns)
    }

    /// Keeps one of several landings, by its number from 1 on, or the last; of a recording with one everything stays, but for other
    /// starts of the vehicle's computer.
    ///
    /// # Errors
    /// How many landings there are, when there is none of this number.
    pub fn keep_landing(&mut self, number: Option<usize>) -> Result<(), usize> {
        let boots = self.other_boots.iter().chain([&*self]);
        let counts: BTreeMap<usize, usize> =
            boots.map(|boot| (boot.boot.number, begins(boot).len())).collect();
        let of: usize = counts.values().sum();
        let number = number.unwrap_or(of.max(1));
        if number == 0 || number > of.max(1) {
            return Err(of);
        }
        let mut before = 0;
        for (boot, count) in counts {
            if (before + 1..=before + count).contains(&number) {
                self.turn_to(boot);
                break;
            }
            before += count;
        }
        self.other_boots.clear();
        if of < 2 {
            return Ok(());
        }
        let begins = begins(self);
        let at = |index: usize| begins.get(index).copied();
        let index = number - 1 - before;
        let begun_ns = at(index).unwrap_or(i64::MIN);
        let from_ns = if index == 0 { i64::MIN } else { begun_ns.saturating_sub(BEFORE_NS) };
        let to_ns = at(index + 1).map_or(i64::MAX, |next_ns| next_ns.saturating_sub(BEFORE_NS));
        self.keep(from_ns..to_ns);
        let before = self.statuses.first().filter(|_| index > 0);
        let detector_changes_before = before.map_or(0, |status| status.detector_changes);
        // A status before the begin is still of the landing before.
        for status in &mut self.statuses {
            if status.started_ns != Some(begun_ns) {
                (status.started_ns, status.disarmed_ns) = (None, None);
            }
        }
        for truth in &mut self.truth {
            truth.touchdown = truth.touchdown.filter(|it| it.stamp_ns >= begun_ns);
        }
        let time_ns = from_ns..to_ns;
        self.landing = Some(Landing { number, of, time_ns, detector_changes_before });
        self.zero_ns = begun_ns;
        Ok(())
    }

    /// Becomes the flight of this start of the vehicle's computer.
    fn turn_to(&mut self, number: usize) {
        if let Some(boot) = self.other_boots.iter_mut().find(|it| it.boot.number == number) {
            *self = std::mem::take(boot);
        }
    }

    fn keep(&mut self, time_ns: Range<i64>) {
        let shift_ns = self.shift_ns;
        let is_received = |it_ns: i64| time_ns.contains(&it_ns.saturating_sub(shift_ns));
        self.statuses.retain(|it| time_ns.contains(&it.stamp_ns));
        self.targets.retain(|it| time_ns.contains(&it.stamp_ns));
        self.vehicle.retain(|it| time_ns.contains(&it.stamp_ns));
        self.truth.retain(|it| time_ns.contains(&it.stamp_ns));
        self.wind.retain(|it| time_ns.contains(&it.stamp_ns));
        self.found.retain(|it| is_received(it.received_ns));
        for frames in self.frames.values_mut() {
            frames.retain(|it| time_ns.contains(&it.stamp_ns));
        }
        for pictures in self.light.values_mut() {
            pictures.retain(|it| time_ns.contains(&it.stamp_ns));
        }
        self.changes.retain(|it| is_received(it.received_ns));
        self.packets.received.retain(|it| is_received(it.received_ns));
        self.packets.power.retain(|it| is_received(it.received_ns));
        self.packets.texts.retain(|it| is_received(it.received_ns));
    }
}
