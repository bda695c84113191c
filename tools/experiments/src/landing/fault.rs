//! Names the circumstances of the landing experiment (lost frames, latency, stamps, GNSS, mount, gusts, occluders, moving
//! pads), as settings of simulator, controller and modelled detector.

use std::f64::consts::TAU;
use std::str::FromStr;

use world::vision::VisionFaults;

/// The vision of a flight.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub enum Vision {
    /// Rendered frames with the real detector.
    Rendered,
    /// A model of the detector's errors.
    Modelled,
}

impl Vision {
    /// Its name.
    pub fn name(self) -> &'static str {
        match self {
            Self::Rendered => "rendered",
            Self::Modelled => "modelled",
        }
    }
}

/// A circumstance besides wind, height, offset and latency.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub struct Fault(usize);

/// The changes by a fault: settings of the simulator and of the controller, and the modelled detector.
#[derive(Clone, Debug, Default)]
pub struct Change {
    /// Settings of the simulator.
    pub simulator: Vec<String>,
    /// Settings of the controller.
    pub controller: Vec<String>,
    /// Faults of the modelled detector; they do not apply to rendered frames.
    pub vision: VisionFaults,
}

/// A row of the table of faults: its name, its description, and its changes for a random number from 0 to 1.
type Row = (&'static str, &'static str, fn(f64) -> Change);

/// The faults that have an effect in one vision only.
const ONE_VISION: [(&str, Vision); 4] = [
    ("wrong-marker", Vision::Modelled),
    ("lie", Vision::Modelled),
    ("glare", Vision::Rendered),
    ("cover", Vision::Rendered),
];

const TABLE: [Row; 24] = [
    ("none", "nothing goes wrong", |_| Change::default()),
    ("lost-below-2m", "no frame is taken from 2 m on", |_| {
        simulator(&["camera.outage_below_m=2", "camera.outage_below_for_s=3600"])
    }),
    ("silence-2s", "no frame is taken for 2 s, at any time", |part| {
        let at = format!("camera.outage_at_s={:.3}", 1.0 + 9.0 * part);
        simulator(&[&at, "camera.outage_for_s=2"])
    }),
    ("latency-300ms", "frames arrive 300 to 350 ms late", |_| {
        simulator(&["camera.latency_ms=300", "camera.jitter_ms=50"])
    }),
    ("half-dropped", "half of the frames never arrive", |_| simulator(&["camera.drop=0.5"])),
    ("out-of-order", "frames arrive up to 250 ms late, a third twice", |_| {
        simulator(&["camera.jitter_ms=250", "camera.duplicate=0.33"])
    }),
    (
        "wrong-marker",
        "in 30 % of the frames another marker, 1 m away, is taken for ours (modelled only)",
        |_| Change {
            vision: VisionFaults { wrong: Some((0.3, 1.0)), ..VisionFaults::default() },
            ..simulator(&["pad.wrong_marker=aruco-4x4-50:7:0.15", "pad.wrong_east_m=1"])
        },
    ),
    ("lie", "detections are off by 0.5 m for 1 s, at any time (modelled only)", |part| {
        let from_s = 1.0 + 9.0 * part;
        let offset = Some((from_s, from_s + 1.0, 0.5));
        Change { vision: VisionFaults { offset, ..VisionFaults::default() }, ..Change::default() }
    }),
    ("stamp-jumps", "a tenth of the stamps jumps by up to 250 ms", |_| {
        simulator(&["camera.stamp_jumps=0.1", "camera.stamp_jump_ms=250"])
    }),
    ("stamp-burst", "all stamps jump by up to 120 ms for half a second, at any time", |part| {
        let at = format!("camera.stamp_jumps_at_s={:.3}", 1.0 + 9.0 * part);
        simulator(&[
            "camera.stamp_jumps=1",
            "camera.stamp_jump_ms=120",
            &at,
            "camera.stamp_jumps_for_s=0.5",
        ])
    }),
    ("stamps-early", "all stamps are 50 ms early", |_| simulator(&["camera.stamp_early_ms=50"])),
    ("gnss-drift", "the believed position drifts by 0.05 m/s", |part| {
        let to = format!("autopilot.gnss_drift_to_deg={:.1}", 360.0 * part);
        simulator(&["autopilot.gnss_drift_m_s=0.05", &to])
    }),
    ("gnss-jump", "the believed position jumps by 1 m, at any time", |part| {
        let at = format!("autopilot.gnss_jump_at_s={:.3}", 1.0 + 9.0 * part);
        simulator(&["autopilot.gnss_jump_m=1", &at])
    }),
    ("link-lost-1s", "the autopilot's link is lost for 1 s, at any time", |part| {
        let at = format!("autopilot.link_lost_at_s={:.3}", 1.0 + 9.0 * part);
        simulator(&[&at, "autopilot.link_lost_for_s=1"])
    }),
    ("mount-1deg", "the mount is off by 1 degree (a deviation, in roll and pitch)", |_| {
        simulator(&["camera.mount_error_deg=1"])
    }),
    ("estimates-3x", "the autopilot's estimates err three times as much as usual", |_| {
        simulator(&["autopilot.errors=3"])
    }),
    (
        "velocity-wander",
        "the autopilot's velocity errs by 0.3 m/s (a deviation) for seconds",
        |_| simulator(&["autopilot.velocity_wander_m_s=0.3"]),
    ),
    ("gust", "a gust of 5 m/s in 3 s, at any time", |part| {
        let at = format!("wind.gust_at_s={:.3}", 1.0 + 8.0 * part);
        simulator(&["wind.gust_m_s=5", "wind.gust_length_s=3", &at])
    }),
    ("ground-effect", "rotors of 0.2 m push harder near the ground", |_| {
        simulator(&["start.rotor_m=0.2"])
    }),
    ("glare", "a reflection beside the marker for 2 s (rendered only)", |part| {
        occluder("glare", part)
    }),
    ("cover", "a third of the marker is covered for 2 s (rendered only)", |part| {
        occluder("cover", part)
    }),
    ("pad-moves-2.5", "the pad comes at 2.5 m/s (its marker half as large again)", |_| {
        moving(2.5, 0.0)
    }),
    ("pad-moves-4.2", "the pad comes at 4.2 m/s (its marker half as large again)", |_| {
        moving(4.2, 0.0)
    }),
    ("pad-heaves", "the pad heaves by 0.3 m in 6 s (its marker half as large again)", |_| {
        moving(0.0, 0.3)
    }),
];

fn simulator(settings: &[&str]) -> Change {
    Change {
        simulator: settings.iter().map(|setting| (*setting).to_owned()).collect(),
        ..Change::default()
    }
}

fn occluder(kind: &str, part: f64) -> Change {
    let (kind, at) =
        (format!("occluder.kind={kind}"), format!("occluder.at_s={:.3}", 1.0 + 8.0 * part));
    simulator(&[&kind, &at, "occluder.strength=0.33", "occluder.for_s=2"])
}

/// How many times larger the marker of a moving pad is.
const MOVING_MARKER_SCALE: f64 = 1.5;

/// A moving pad, at twice the frame rate, with a controller configured for it.
fn moving(speed_m_s: f64, heave_m: f64) -> Change {
    let speed = format!("pad.speed_m_s={speed_m_s}");
    let heave = format!("pad.heave_m={heave_m}");
    let simulated = ["pad.marker=rings:0.23", "camera.rate_hz=30", &speed, &heave];
    let settings: &[&str] = if heave_m > 0.0 {
        &["estimator.pad_heave_m_s=0.4", "metric.gust_time_s=1.2"]
    } else {
        &[
            "estimator.pad_speed_m_s=4.5",
            "estimator.pad_acceleration=0.08",
            "envelope.horizontal_m_s=7",
            "metric.max_lateral_m_s=2.5",
            "metric.lateral_acceleration_m_s2=2",
            "metric.gust_time_s=1.2",
            "metric.blind_deviation_m=0.2",
        ]
    };
    Change {
        controller: settings.iter().map(|setting| (*setting).to_owned()).collect(),
        ..simulator(&simulated)
    }
}

impl Fault {
    /// No fault.
    pub const NONE: Self = Self(0);

    /// All faults.
    pub fn all() -> impl Iterator<Item = Self> {
        (0..TABLE.len()).map(Self)
    }

    /// Its name.
    pub fn name(self) -> &'static str {
        TABLE.get(self.0).map_or("none", |row| row.0)
    }

    /// Its description.
    pub fn words(self) -> &'static str {
        TABLE.get(self.0).map_or("", |row| row.1)
    }

    /// Whether it has an effect in flights with this vision, or is none.
    pub fn works_in(self, vision: Vision) -> bool {
        let only = ONE_VISION.iter().find(|(name, _)| *name == self.name());
        only.is_none_or(|(_, only)| *only == vision)
    }

    /// The factor by which the pad's marker is larger than requested.
    pub fn marker_scale(self) -> f64 {
        if self.name().starts_with("pad-") { MOVING_MARKER_SCALE } else { 1.0 }
    }

    /// Its changes in the flight of a seed.
    pub fn change(self, seed: u64) -> Change {
        let mut change =
            TABLE.get(self.0).map_or_else(Change::default, |row| row.2(drawn(seed, 9)));
        if change.simulator.iter().any(|setting| setting.starts_with("pad.speed_m_s")) {
            // Towards the vehicle within 45 degrees, so that it comes into view.
            let course = drawn_angle(seed, START_ANGLE).to_degrees() + 90.0 * drawn(seed, 9) - 45.0;
            change.simulator.push(format!("pad.course_deg={:.1}", course.rem_euclid(360.0)));
        }
        change
    }
}

impl FromStr for Fault {
    type Err = String;

    fn from_str(name: &str) -> Result<Self, String> {
        let found = TABLE.iter().position(|row| row.0 == name).map(Self);
        found.ok_or_else(|| {
            let names: Vec<&str> = TABLE.iter().map(|row| row.0).collect();
            format!("there is no fault `{name}`; there are {}", names.join(", "))
        })
    }
}

/// The index of the random angle from the pad to the start.
pub const START_ANGLE: u32 = 6;

/// The index from which on numbers are mixed thoroughly. Of those below, which published landings depend on, two whose indices
/// differ by 15 are nearly one.
const THOROUGH: u32 = 20;

/// A random number from 0 to 1 for a seed and an index.
pub fn drawn(seed: u64, which: u32) -> f64 {
    let mixed = if which < THOROUGH {
        (seed.wrapping_add(1))
            .wrapping_mul(0x9e37_79b9_7f4a_7c15)
            .rotate_left(17 * which + 5)
            .wrapping_mul(0xd6e8_feb8_6659_fd93)
    } else {
        splitmix64(splitmix64(seed).wrapping_add(u64::from(which)))
    };
    (mixed >> 11) as f64 / (1u64 << 53) as f64
}

/// A number; each of its bits depends on all of these.
fn splitmix64(number: u64) -> u64 {
    let mixed = number.wrapping_add(0x9e37_79b9_7f4a_7c15);
    let mixed = (mixed ^ (mixed >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let mixed = (mixed ^ (mixed >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    mixed ^ (mixed >> 31)
}

/// A random angle for a seed and an index, in radians.
pub fn drawn_angle(seed: u64, which: u32) -> f64 {
    TAU * drawn(seed, which)
}

#[cfg(test)]
mod tests {
    use super::*;
    use node::Layers;

    #[test]
    fn every_fault_has_a_unique_name_and_valid_settings() {
        for fault in Fault::all() {
            assert_eq!(fault.name().parse(), Ok(fault));
            let Change { simulator, controller, .. } = fault.change(3);
            let layers = |set: Vec<String>| Layers { file: None, set };
            layers(simulator).load::<simulator::Config>().unwrap();
            layers(controller).load::<controller::Config>().unwrap();
        }
    }

    #[test]
    fn a_fault_changes_flights_in_each_vision_in_which_it_works() {
        for fault in Fault::all().skip(1) {
            let change = fault.change(3);
            let is_of_frames = change.simulator.iter().any(|it| it.starts_with("occluder."));
            let is_of_model = change.vision != VisionFaults::default();
            assert_eq!(fault.works_in(Vision::Rendered), !is_of_model, "{}", fault.name());
            assert_eq!(fault.works_in(Vision::Modelled), !is_of_frames, "{}", fault.name());
        }
        for (name, _) in ONE_VISION {
            assert!(name.parse::<Fault>().is_ok(), "{name}");
        }
    }

    #[test]
    fn numbers_that_one_flight_draws_do_not_depend_on_each_other() {
        // Those of a landing, and those of a flight with faults.
        for indices in [(1..=9).collect(), [6, 7, 8].into_iter().chain(20..=28).collect()] {
            let indices: Vec<u32> = indices;
            for (at, &one) in indices.iter().enumerate() {
                for &other in &indices[at + 1..] {
                    let mut cells = [0; 64];
                    for seed in 1..=1000 {
                        let part = |which| (8.0 * drawn(seed, which)) as usize;
                        cells[8 * part(one) + part(other)] += 1;
                    }
                    assert!(!cells.contains(&0), "{one} and {other}: {cells:?}");
                }
            }
        }
    }
}
