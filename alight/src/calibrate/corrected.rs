//! The corrected camera as tables of camera-pub's configuration.

use std::fmt::Write as _;

use calibration::flight::QUANTITIES;
use calibration::{FlightCalibration, Quantity};
use geometry::Distortion;

use super::recorded::RecordedFlight;

/// The tables that replace those of the same names; `None` when nothing was observable.
pub(super) fn toml(flight: &RecordedFlight, result: &FlightCalibration) -> Option<String> {
    let correction = |wanted: Quantity| {
        let index = QUANTITIES.iter().position(|quantity| *quantity == wanted)?;
        Some(result.estimates[index].correction()).filter(|value| *value != 0.0)
    };
    let mut text = format!(
        "# Found by `alight calibrate flight`: these keys replace those in the configuration of the camera `{}`.\n",
        // The name comes from a file, and ends no comment.
        flight.camera.escape_debug()
    );
    let mut is_empty = true;
    if let Some(offset_s) = correction(Quantity::TimeOffset) {
        is_empty = false;
        text.push_str(&delay(flight, offset_s));
    }
    if correction(Quantity::FocalScale).or(correction(Quantity::K1)).is_some() {
        is_empty = false;
        text.push_str(&intrinsics(result));
    }
    let turns = [Quantity::MountRoll, Quantity::MountPitch, Quantity::MountYaw];
    if turns.into_iter().any(|quantity| correction(quantity).is_some()) {
        is_empty = false;
        let mount = result.camera.body_from_camera;
        let [w, x, y, z] = mount.rotation().wxyz();
        // Writing to a string cannot fail.
        let _ = write!(
            text,
            "\n[mount]\norientation = \"quaternion\"\nrotation_wxyz = [{w:.9}, {x:.9}, {y:.9}, {z:.9}]\n"
        );
    }
    (!is_empty).then_some(text)
}

fn delay(flight: &RecordedFlight, offset_s: f64) -> String {
    let offset_ms = 1e3 * offset_s;
    let told = format!("frames are exposed {offset_ms:+.2} ms after their stamps");
    if flight.is_stamped_by_camera {
        return format!(
            "\n# {told}. The camera stamps them itself, so no key corrects that: check `source.stamp_at`, `source.readout_ms` and the\n\
             # delay of the autopilot's telemetry.\n"
        );
    }
    match flight.delay_ms.map(|delay_ms| delay_ms - offset_ms) {
        Some(delay_ms) if delay_ms >= 0.0 => {
            format!("\n# {told}.\n[source]\ndelay_ms = {delay_ms:.2}\n")
        }
        _ => format!("\n# {told}: make `source.delay_ms` smaller by {offset_ms:.2}.\n"),
    }
}

fn intrinsics(result: &FlightCalibration) -> String {
    let model = &result.camera.model;
    let (lens, numbers): (&str, &[f64]) = match &model.distortion {
        Distortion::None => ("pinhole", &[]),
        Distortion::BrownConrady(k) => ("brown-conrady", k),
        Distortion::KannalaBrandt(k) => ("kannala-brandt", k),
    };
    let numbers: Vec<String> = numbers.iter().map(|number| format!("{number:.9}")).collect();
    format!(
        "\n[calibration]\nfile = \"\"\nfocal_px = [{:.4}, {:.4}]\nprincipal_px = [{:.4}, {:.4}]\nlens = \"{lens}\"\ndistortion = [{}]\n",
        model.fx,
        model.fy,
        model.cx,
        model.cy,
        numbers.join(", ")
    )
}
