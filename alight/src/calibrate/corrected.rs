//! The keys of camera-pub's configuration that a calibration from a flight changes (delay, mount, focal length, distortion), each with its
//! value before and after, as text and as TOML tables.

use calibration::flight::QUANTITIES;
use calibration::{FlightCalibration, Quantity};
use geometry::Distortion;
use toml::Value;

use super::recorded::RecordedFlight;

/// The changes of a camera's configuration by a calibration.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Changes {
    /// The keys, those of a table together.
    pub(super) keys: Vec<Change>,
    /// Why no key corrects the time offset, and what to do instead.
    pub(super) advice: Option<String>,
}

/// A key that gets another value.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Change {
    pub(super) table: &'static str,
    pub(super) key: &'static str,
    /// Its value as TOML.
    pub(super) value: String,
    pub(super) before: Before,
}

/// The value of a key in the camera's configuration before the calibration.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Before {
    /// The recording has no configuration of the camera.
    Unknown,
    /// It had no such key.
    Absent,
    /// Its value as TOML.
    Was(String),
}

impl Before {
    /// Whether it was this value, which may have been written with other digits.
    fn is(&self, value: &str) -> bool {
        match self {
            Self::Was(before) => {
                parsed(before).zip(parsed(value)).is_some_and(|(one, other)| is_same(&one, &other))
            }
            Self::Unknown | Self::Absent => false,
        }
    }
}

/// A value as TOML.
fn parsed(value: &str) -> Option<Value> {
    format!("value = {value}").parse::<toml::Table>().ok()?.remove("value")
}

fn is_same(one: &Value, other: &Value) -> bool {
    let number = |value: &Value| value.as_float().or(value.as_integer().map(|it| it as f64));
    match (one, other) {
        (Value::Array(one), Value::Array(other)) => {
            one.len() == other.len() && one.iter().zip(other).all(|(a, b)| is_same(a, b))
        }
        _ => match (number(one), number(other)) {
            (Some(one), Some(other)) => one == other,
            _ => one == other,
        },
    }
}

/// The changes; none if no quantity was observable.
pub(super) fn changes(flight: &RecordedFlight, result: &FlightCalibration) -> Changes {
    let correction = |wanted: Quantity| {
        let index = QUANTITIES.iter().position(|quantity| *quantity == wanted)?;
        Some(result.estimates.get(index)?.correction()).filter(|value| *value != 0.0)
    };
    let mut changes = Changes::default();
    let mut set = |table, key, value: String| {
        let before = before(flight, table, key);
        if !before.is(&value) {
            changes.keys.push(Change { table, key, value, before });
        }
    };
    let mut advice = None;
    if let Some(offset_s) = correction(Quantity::TimeOffset) {
        match delay_ms(flight, 1e3 * offset_s) {
            Ok(delay_ms) => set("source", "delay_ms", format!("{delay_ms:.2}")),
            Err(why) => advice = Some(why),
        }
    }
    if correction(Quantity::FocalScale).or(correction(Quantity::K1)).is_some() {
        let model = &result.camera.model;
        let (lens, numbers): (&str, &[f64]) = match &model.distortion {
            Distortion::None => ("pinhole", &[]),
            Distortion::BrownConrady(k) => ("brown-conrady", k),
            Distortion::KannalaBrandt(k) => ("kannala-brandt", k),
        };
        let numbers: Vec<String> = numbers.iter().map(|number| format!("{number:.9}")).collect();
        set("calibration", "file", "\"\"".to_owned());
        // camera-pub refuses keys that convert the camera of a file if no file is given.
        for (key, nothing) in [("binning", "0"), ("region_px", "[]")] {
            if matches!(before(flight, "calibration", key), Before::Was(_)) {
                set("calibration", key, nothing.to_owned());
            }
        }
        set("calibration", "focal_px", format!("[{:.4}, {:.4}]", model.fx, model.fy));
        set("calibration", "principal_px", format!("[{:.4}, {:.4}]", model.cx, model.cy));
        set("calibration", "lens", format!("\"{lens}\""));
        set("calibration", "distortion", format!("[{}]", numbers.join(", ")));
    }
    let turns = [Quantity::MountRoll, Quantity::MountPitch, Quantity::MountYaw];
    if turns.into_iter().any(|quantity| correction(quantity).is_some()) {
        let [w, x, y, z] = result.camera.body_from_camera.rotation().wxyz();
        set("mount", "orientation", "\"quaternion\"".to_owned());
        // camera-pub refuses angles that no longer have an effect.
        if matches!(before(flight, "mount", "roll_pitch_yaw_deg"), Before::Was(_)) {
            set("mount", "roll_pitch_yaw_deg", "[0.0, 0.0, 90.0]".to_owned());
        }
        set("mount", "rotation_wxyz", format!("[{w:.9}, {x:.9}, {y:.9}, {z:.9}]"));
    }
    Changes { advice, ..changes }
}

fn before(flight: &RecordedFlight, table: &str, key: &str) -> Before {
    let Some(configuration) = &flight.configuration else { return Before::Unknown };
    let value = configuration.get(table).and_then(|table| table.get(key));
    value.map_or(Before::Absent, |value| Before::Was(value.to_string()))
}

/// The delay that makes stamps right.
///
/// # Errors
/// The reason why no key does, and what to do.
fn delay_ms(flight: &RecordedFlight, offset_ms: f64) -> Result<f64, String> {
    let offset = format!("frames are exposed {offset_ms:+.2} ms after their stamps, and");
    if flight.is_stamped_by_camera {
        return Err(format!(
            "{offset} no key corrects that, as the camera stamps them itself: check `source.stamp_at`, `source.readout_ms` and the \
             delay of the autopilot's telemetry"
        ));
    }
    let delay = before(flight, "source", "delay_ms");
    let Before::Was(delay) = delay else {
        return Err(format!(
            "{offset} the previous `source.delay_ms` is not known, as the recording has no configuration of camera-pub `{}`: make it \
             smaller by {offset_ms:.2}, or stamp them later if another program is the camera",
            // The name comes from a file.
            flight.camera.escape_debug()
        ));
    };
    let delay_ms = delay.parse::<f64>().unwrap_or_default() - offset_ms;
    if delay_ms >= 0.0 {
        return Ok(delay_ms);
    }
    Err(format!(
        "{offset} `source.delay_ms` = {delay} cannot be made smaller by that: check the delay of the autopilot's telemetry"
    ))
}

impl Changes {
    /// The tables that replace those of the same names; a comment alone where no key changes.
    pub(super) fn toml(&self, camera: &str) -> String {
        let mut text = match self.keys.is_empty() {
            true => format!(
                "# `alight calibrate flight`: no key of the camera `{}` changes.\n",
                camera.escape_debug()
            ),
            false => format!(
                "# Found by `alight calibrate flight`: these keys replace those in the configuration of the camera `{}`.\n",
                // The name comes from a file, and ends no comment.
                camera.escape_debug()
            ),
        };
        if let Some(advice) = &self.advice {
            text.push_str(&format!("# Not here: {advice}.\n"));
        }
        let mut table = "";
        for change in &self.keys {
            if change.table != table {
                table = change.table;
                text.push_str(&format!("\n[{table}]\n"));
            }
            text.push_str(&format!("{} = {}\n", change.key, change.value));
        }
        text
    }

    /// Text lines: the change of each key, and the error that no key corrects.
    pub(super) fn lines(&self, camera: &str) -> Vec<String> {
        let key = |change: &Change| {
            let name = change.name();
            match &change.before {
                Before::Unknown => format!(
                    "set: `{name}` = {} (the previous value is not known: the recording has no configuration of camera-pub `{}`)",
                    change.value,
                    camera.escape_debug()
                ),
                Before::Absent => format!("added: `{name}` = {}", change.value),
                Before::Was(before) => {
                    format!("changed: `{name}` from {before} to {}", change.value)
                }
            }
        };
        let left = self.advice.iter().map(|advice| format!("left: {advice}"));
        self.keys.iter().map(key).chain(left).collect()
    }

    /// The key that corrects a quantity; `None` where none does.
    pub(super) fn key_of(&self, quantity: Quantity) -> Option<String> {
        let key = match quantity {
            Quantity::TimeOffset => "source.delay_ms",
            Quantity::MountRoll | Quantity::MountPitch | Quantity::MountYaw => {
                "mount.rotation_wxyz"
            }
            Quantity::FocalScale => "calibration.focal_px",
            Quantity::K1 => "calibration.distortion",
        };
        self.keys.iter().map(Change::name).find(|name| name == key)
    }
}

impl Change {
    /// Its dotted name.
    pub(super) fn name(&self) -> String {
        format!("{}.{}", self.table, self.key)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_value_with_other_digits_is_no_change() {
        let was = |before: &str, value: &str| Before::Was(before.to_owned()).is(value);
        assert!(was("[647.5, 485.5]", "[647.5000, 485.5000]") && was("640", "640.00"));
        assert!(was("[]", "[]") && was("'down'", "\"down\""));
        assert!(!was("[647.5, 485.5]", "[647.5001, 485.5000]") && !was("[1.0]", "[1.0, 0.0]"));
        assert!(!was("\"\"", "0") && !Before::Absent.is("0") && !Before::Unknown.is("0"));
    }
}
