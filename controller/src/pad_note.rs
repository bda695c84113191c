//! Where the pad is, kept for the controller that is started next.
//!
//! ArduPilot says up to 7 s late that a vehicle touched down that follows setpoints, and low over the marker the camera does
//! not see it. A controller that is started in that time would search, and climb from the ground. It learns from a
//! [`PadNote`] that the vehicle is right over the pad.

use geometry::Point;
use landing::{RememberedPad, SeenPad, Timestamp};
use serde::{Deserialize, Serialize};

/// Heights over the pad at which its place is noted in a descent, in metres. Few, as each is written to a file.
const LEVELS_M: [f64; 4] = [3.0, 1.5, 0.7, 0.3];
/// Climb above the first of them after which the note is dropped, in metres.
const CLIMBED_M: f64 = 0.5;

/// The place of the pad, with the vehicle in whose coordinates it is.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PadNote {
    /// The link's address, which tells vehicles with the same system id apart.
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

    /// What is to be kept; `None` when nothing is.
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
        if level > self.level {
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

    #[test]
    fn what_an_earlier_controller_left_stays_until_the_landing_goes_on() {
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
