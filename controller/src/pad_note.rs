//! Where the pad is during a landing, as a note for the controller that is started after a crash and resumes that landing.
//!
//! ArduPilot reports up to 7 s late that a vehicle touched down that follows setpoints, and low over the marker the camera does
//! not see it. A controller that is started in that time would search, and climb from the ground. It learns from a
//! [`PadNote`] that the vehicle is right over the pad.

use geometry::Point;
use landing::{RememberedPad, SeenPad, Timestamp};
use serde::{Deserialize, Serialize};

/// Heights over the pad at which its place is noted in a descent, in metres. Few, as each is written to a file.
const LEVELS_M: [f64; 4] = [3.0, 1.5, 0.7, 0.3];
/// Age after which the note of a vehicle that is below the first of them is renewed, in nanoseconds: the autopilot's position
/// drifts, and an old note is not used.
const MAX_NOTE_AGE_NS: i64 = 10_000_000_000;
/// Climb above the first of them after which the note is dropped, in metres.
const CLIMBED_M: f64 = 0.5;

/// The place of the pad, with the vehicle in whose coordinates it is.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PadNote {
    /// The link's address, which distinguishes vehicles with the same system id.
    pub address: String,
    /// The vehicle's MAVLink system id.
    pub system: u8,
    /// The time of it, in nanoseconds of the controller's clock.
    pub stamp_ns: i64,
    /// The pad's place, north, east and down of the autopilot's local origin, in metres.
    pub position_ned_m: [f64; 3],
    /// Standard deviation of its horizontal position, in metres.
    pub deviation_m: f64,
}

/// The note of the present landing.
#[derive(Debug, Default)]
pub struct PadNotes {
    note: Option<PadNote>,
    /// How many of the levels the vehicle has come below.
    level: usize,
    was_landing: bool,
}

impl PadNotes {
    /// Takes over the note of an earlier controller.
    pub fn take_over(&mut self, note: PadNote) {
        self.note = Some(note);
    }

    /// The note to store; `None` if there is none.
    pub fn note(&self) -> Option<&PadNote> {
        self.note.as_ref()
    }

    /// The pad's place, if the note is of this vehicle.
    pub fn pad(&self, address: &str, system: Option<u8>) -> Option<RememberedPad> {
        let is_ours = |it: &&PadNote| it.address == address && Some(it.system) == system;
        let note = self.note.as_ref().filter(is_ours)?;
        let [north, east, down] = note.position_ned_m;
        Some(RememberedPad {
            position: Point::new(north, east, down),
            deviation_m: note.deviation_m,
            stamp: Timestamp::from_nanos(note.stamp_ns),
        })
    }

    /// Follows a landing, in which the pad was seen.
    pub fn step(
        &mut self,
        is_landing: bool,
        seen: Option<SeenPad>,
        address: &str,
        system: Option<u8>,
    ) {
        let is_over = std::mem::replace(&mut self.was_landing, is_landing) && !is_landing;
        let is_high = seen.is_some_and(|seen| seen.height_m > LEVELS_M[0] + CLIMBED_M);
        if is_over || is_high {
            (self.note, self.level) = (None, 0);
        }
        let (Some(SeenPad { pad, height_m }), Some(system), true) = (seen, system, is_landing)
        else {
            return;
        };
        let level = LEVELS_M.iter().filter(|level_m| height_m <= **level_m).count();
        let is_old = self
            .note
            .as_ref()
            .is_some_and(|note| pad.stamp.nanos().saturating_sub(note.stamp_ns) > MAX_NOTE_AGE_NS);
        if level > self.level || (level > 0 && is_old) {
            self.level = level;
            self.note = Some(PadNote {
                address: address.to_owned(),
                system,
                stamp_ns: pad.stamp.nanos(),
                position_ned_m: pad.position.coords.into(),
                deviation_m: pad.deviation_m,
            });
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const ADDRESS: &str = "udpin:127.0.0.1:14550";

    #[test]
    fn the_place_is_noted_a_few_times_in_a_descent_and_dropped_after_the_landing() {
        let mut notes = PadNotes::default();
        let mut kept = Vec::new();
        for centimetres in (0..1000).rev() {
            let height_m = f64::from(centimetres) / 100.0;
            let pad = RememberedPad {
                position: Point::new(1.0, 2.0, 0.1),
                deviation_m: 0.02,
                stamp: Timestamp::from_seconds(50.0 - height_m),
            };
            notes.step(true, Some(SeenPad { pad, height_m }), ADDRESS, Some(1));
            if notes.note() != kept.last() {
                kept.extend(notes.note().cloned());
            }
        }
        assert_eq!(kept.len(), 4, "{kept:?}");
        let pad = notes.pad(ADDRESS, Some(1)).map(|pad| (pad.position, pad.stamp));
        assert_eq!(pad, Some((Point::new(1.0, 2.0, 0.1), Timestamp::from_seconds(49.7))));
        assert_eq!(notes.pad(ADDRESS, Some(2)), None);
        assert_eq!(notes.pad("udpin:127.0.0.1:14551", Some(1)), None);
        notes.step(false, None, ADDRESS, Some(1));
        assert_eq!(notes.note(), None);
    }

    /// The stamps of the notes, in seconds, of a vehicle that is seen over the pad at these heights, 40 times a second.
    fn noted_at_s(seconds: f64, height_m: impl Fn(f64) -> f64) -> Vec<f64> {
        let mut notes = PadNotes::default();
        let mut kept = Vec::new();
        for i in 0..(seconds * 40.0) as u32 {
            let s = f64::from(i) / 40.0;
            let pad = RememberedPad {
                position: Point::new(1.0, 2.0, 0.1),
                deviation_m: 0.02,
                stamp: Timestamp::from_seconds(s),
            };
            let seen = SeenPad { pad, height_m: height_m(s) };
            notes.step(true, Some(seen), ADDRESS, Some(1));
            let stamp_s = notes.note().map(|note| note.stamp_ns as f64 * 1e-9);
            if stamp_s != kept.last().copied() {
                kept.extend(stamp_s);
            }
        }
        kept
    }

    #[test]
    fn the_place_is_noted_again_in_a_second_descent_and_seldom_in_a_long_wait() {
        // It descends, climbs to 3.2 m to try again, and descends once more, half a minute later.
        let again = |s: f64| match s {
            s if s < 10.0 => 3.3 - 0.32 * s,
            s if s < 15.0 => 0.1 + 0.62 * (s - 10.0),
            s if s < 40.0 => 3.2,
            s => 3.2 - 0.31 * (s - 40.0),
        };
        let second: Vec<_> = noted_at_s(50.0, again).into_iter().filter(|s| *s > 40.0).collect();
        assert_eq!(second.len(), 4, "{second:?}");
        let waits = noted_at_s(60.0, |s| 0.7 + 0.05 * (3.0 * s).sin());
        assert!((5..=12).contains(&waits.len()), "{waits:?}");
        assert!(waits.last().is_some_and(|last_s| *last_s > 49.0), "{waits:?}");
    }

    #[test]
    fn a_note_of_an_earlier_controller_stays_until_the_landing_continues() {
        let note = PadNote {
            address: ADDRESS.into(),
            system: 1,
            stamp_ns: 7,
            position_ned_m: [0.0; 3],
            deviation_m: 0.1,
        };
        let mut notes = PadNotes::default();
        notes.take_over(note.clone());
        notes.step(false, None, ADDRESS, Some(1));
        assert_eq!(notes.note(), Some(&note));
        notes.step(true, None, ADDRESS, Some(1));
        assert_eq!(notes.note(), Some(&note));
        notes.step(false, None, ADDRESS, Some(1));
        assert_eq!(notes.note(), None);
    }
}
