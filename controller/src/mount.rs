//! Warnings of a camera mount, focal length, marker size or standing height that differs from the configuration, and of detections that scatter
//! more than they state.

use landing::{Measured, MountFindings, ScatterExcess};

use crate::refusals::Warning;

/// Maximum difference between the configured and the measured standing height without a warning, in metres: the error of
/// the measurement (`landing`'s module `standing`).
const MAX_STANDING_ERROR_M: f64 = 0.15;

/// The warning of a detector, the active one, whose detections scatter more than they state.
pub fn scatter_warning(excess: ScatterExcess, detector: &str) -> Warning {
    let ScatterExcess { measured_m, stated_m } = excess;
    Warning {
        matter: format!("scatter {detector}"),
        text: format!(
            "the positions of detector `{detector}` scatter by {measured_m:.2} m, {:.0} times what its covariance and the vehicle's noise explain; the landing uses the measured scatter: \
             check `pose.covariance`, in m^2, that poses and stamps are of the same frame, and `mount`",
            measured_m / stated_m
        ),
    }
}

/// The warnings of the measurements in flight. A marker that is so many times as large as configured causes all other errors, so it alone
/// is reported.
pub fn warnings(found: &MountFindings, size_ratio: Option<f64>) -> Vec<Warning> {
    if let Some(times) = size_ratio {
        return vec![Warning {
            matter: "marker-size".to_owned(),
            text: format!(
                "the marker seems {times:.1} times as large as configured: check the marker's size, the printed one and that of the detectors' `markers`"
            ),
        }];
    }
    let degrees = |angle: Measured| {
        let [value, deviation] = [angle.value.abs(), angle.deviation].map(f64::to_degrees);
        format!("{value:.1} +- {deviation:.1} degrees")
    };
    let percent = |ratio: Measured| {
        let [value, deviation] = [ratio.value.abs(), ratio.deviation].map(|part| 100.0 * part);
        format!("{value:.1} +- {deviation:.1} %")
    };
    let turned = |axis: &str, angle: Measured, [positive, negative]: [&str; 2]| {
        let where_to = if angle.value > 0.0 { positive } else { negative };
        let text = format!(
            "the camera's mount is {} off in {axis}, it looks further {where_to} than configured: check `mount`, and the autopilot's level",
            degrees(angle)
        );
        Warning { matter: format!("mount-{axis}"), text }
    };
    let larger = |ratio: Measured| if ratio.value > 0.0 { "larger" } else { "smaller" };
    let focal = |ratio: Measured| Warning {
        matter: "focal-length".to_owned(),
        text: format!(
            "the image moves as if the camera's focal length were {} {} than configured: where further flights show it as well, check its calibration and its zoom; else the autopilot's attitude or velocity was wrong",
            percent(ratio),
            larger(ratio)
        ),
    };
    let size = |ratio: Measured| Warning {
        matter: "marker-size".to_owned(),
        text: format!(
            "the marker is {} {} than configured: measure the printed one",
            percent(ratio),
            larger(ratio)
        ),
    };
    [
        found.roll_rad.map(|angle| turned("roll", angle, ["to the left", "to the right"])),
        found.pitch_rad.map(|angle| turned("pitch", angle, ["forward", "backward"])),
        found.focal_ratio.map(focal),
        found.size_ratio.map(size),
    ]
    .into_iter()
    .flatten()
    .collect()
}

/// The warning of a vehicle that stands higher over the pad than configured; both in metres. None where the marker's size is wrong, by
/// which the height was measured.
pub fn standing_warning(
    measured_m: f64,
    configured_m: f64,
    size_ratio: Option<f64>,
) -> Option<Warning> {
    let is_higher = size_ratio.is_none() && measured_m - configured_m > MAX_STANDING_ERROR_M;
    is_higher.then(|| Warning {
        matter: "standing-height".to_owned(),
        text: format!(
            "the vehicle stood about {measured_m:.1} m over the pad, not {configured_m:.2} m: measure how high the autopilot sits over the ground, and write it into `metric.standing_height_m`"
        ),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_vehicle_that_stands_higher_than_configured_is_reported() {
        assert!(standing_warning(0.25, 0.2, None).is_none());
        let text = standing_warning(0.25, 0.0, None).unwrap().text;
        assert!(text.contains("about 0.2 m") && text.contains("0.00 m"), "{text}");
    }

    #[test]
    fn measurements_by_a_marker_of_another_size_are_not_reported() {
        let pitch_rad = Some(Measured { value: 0.2, deviation: 0.01 });
        let found = MountFindings { pitch_rad, ..MountFindings::default() };
        let found_warnings = warnings(&found, Some(2.04));
        let [warning] = found_warnings.as_slice() else { unreachable!("{found_warnings:?}") };
        assert!(warning.text.starts_with("the marker seems 2.0 times as large as configured"));
        assert!(standing_warning(0.5, 0.0, Some(2.04)).is_none());
    }

    #[test]
    fn angles_are_reported_in_degrees_and_ratios_in_percent() {
        assert!(warnings(&MountFindings::default(), None).is_empty());
        let found = MountFindings {
            pitch_rad: Some(Measured { value: -0.0541, deviation: 0.007 }),
            focal_ratio: Some(Measured { value: 0.05, deviation: 0.004 }),
            ..MountFindings::default()
        };
        let texts: Vec<String> =
            warnings(&found, None).into_iter().map(|warning| warning.text).collect();
        assert!(
            texts[0].contains("3.1 +- 0.4 degrees off in pitch, it looks further backward"),
            "{texts:?}"
        );
        assert!(texts[1].contains("5.0 +- 0.4 % larger"), "{texts:?}");
    }
}
