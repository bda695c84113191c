//! Sets exposure time and gain of a V4L2 device by its controls: their ranges, when a change has taken effect, and back to its
//! own metering.

use metering::{Limits, Setting};

use super::abi::{
    CID_EXPOSURE_ABSOLUTE, CID_EXPOSURE_AUTO, Call, Device, EXPOSURE_MANUAL, ExtControl,
};
use super::describe::{ControlDescription, control_value};

/// The unit of the exposure's control, in seconds.
const UNIT_S: f64 = 1e-4;
/// How much longer or shorter than wanted an exposure may be for white to stay good (`metering::control`).
const CLOSE: std::ops::RangeInclusive<f64> = 0.9..=1.13;
/// `V4L2_EXPOSURE_APERTURE_PRIORITY`, with which UVC cameras meter, and `V4L2_EXPOSURE_AUTO` of others.
const METERING: [i32; 2] = [3, 0];
/// Number of refusals after which a camera's own gain is not put back any more.
const MAX_GAIN_REFUSALS: u32 = 5;

/// How a device's exposure is to be set for the marker.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct ForMarker {
    pub(crate) max_exposure_s: f64,
    /// The gain's control; empty for none.
    pub(crate) gain: String,
    /// How much brighter its largest value is than its smallest.
    pub(crate) max_gain: f64,
    /// Number of frames until a change shows.
    pub(crate) settle_frames: u32,
}

/// An order for a device's exposure.
#[derive(Copy, Clone, Debug, PartialEq)]
pub(crate) enum Order {
    Keep,
    /// The camera meters on its own.
    OwnMetering,
    /// It does not any more; exposure and gain stay as it has chosen them.
    TakeOver,
    Set(Setting),
}

/// The controls and their values.
pub(crate) struct Exposer {
    wanted: ForMarker,
    /// The value of the metering's control with which the camera meters; `None` where it never does.
    metering: Option<i32>,
    exposure: Range,
    gain: Option<Gain>,
    /// Whether the camera certainly meters on its own: it keeps settings of another program or an earlier start.
    is_metering: bool,
    /// The gain's value before it was set here.
    own_gain: Option<i32>,
    /// How often the camera has refused to have it back.
    gain_refusals: u32,
    setting: Option<Setting>,
    /// Frames since the last change, and when that was ordered.
    frames: u32,
    ordered_ns: i64,
    /// By how much the exposure changed then.
    changed_ns: u32,
}

#[derive(Copy, Clone)]
struct Range {
    min: i32,
    max: i32,
}

#[derive(Copy, Clone)]
struct Gain {
    id: u32,
    range: Range,
}

impl Exposer {
    /// The controls of a device.
    ///
    /// # Errors
    /// Which one it lacks.
    pub(crate) fn of(known: &[ControlDescription], wanted: &ForMarker) -> Result<Self, String> {
        let writable =
            |found: &&ControlDescription| found.is_writable && i32::try_from(found.max).is_ok();
        let range = |found: &ControlDescription| Range {
            min: found.min.clamp(0, i64::from(i32::MAX)) as i32,
            max: found.max as i32,
        };
        let with = |id| known.iter().filter(writable).find(|control| control.id == id);
        let exposure = with(CID_EXPOSURE_ABSOLUTE).ok_or(
            "it has no control for its exposure time, with which `exposure.control` could be `marker`",
        )?;
        let named = |name: &String| known.iter().filter(writable).find(|c| c.name == *name);
        let gain = match &wanted.gain {
            none if none.is_empty() => None,
            name => Some(named(name).ok_or_else(|| {
                let names: Vec<_> = known.iter().map(|control| control.name.as_str()).collect();
                let names = names.join(", ");
                format!("it has no control `{name}` of `exposure.gain`; it has {names}; write \"\" for none")
            })?),
        };
        let metering = with(CID_EXPOSURE_AUTO).map(|auto| {
            let default = auto.default as i32;
            let [usual, other] = METERING;
            match default == EXPOSURE_MANUAL {
                false => default,
                true if auto.max >= i64::from(usual) => usual,
                true => other,
            }
        });
        Ok(Self {
            wanted: wanted.clone(),
            metering,
            exposure: range(exposure),
            gain: gain.map(|gain| Gain { id: gain.id, range: range(gain) }),
            is_metering: false,
            own_gain: None,
            gain_refusals: 0,
            setting: None,
            frames: 0,
            ordered_ns: i64::MIN,
            changed_ns: 0,
        })
    }

    /// The range of its values.
    pub(crate) fn limits(&self) -> Limits {
        let min_exposure_s = f64::from(self.exposure.min.max(1)) * UNIT_S;
        let max_exposure_s = f64::from(self.exposure.max) * UNIT_S;
        Limits {
            min_exposure_s,
            max_exposure_s: max_exposure_s.min(self.wanted.max_exposure_s).max(min_exposure_s),
            max_gain: if self.gain.is_some() { self.wanted.max_gain } else { 1.0 },
        }
    }

    /// Counts a frame, which had been read from the sensor then: one that was ready before the last change was ordered, and
    /// waited in the driver's buffers, does not show it.
    pub(crate) fn frame(&mut self, read_ns: Option<i64>) {
        if read_ns.is_none_or(|read_ns| read_ns >= self.ordered_ns) {
            self.frames = self.frames.saturating_add(1);
        }
    }

    /// The setting with which the newest frame was taken; `None` while the camera meters, or a change may be under way.
    pub(crate) fn setting(&self) -> Option<Setting> {
        self.setting.filter(|_| !self.is_settling())
    }

    /// The last setting; `None` while the camera's exposure is not set here.
    pub(crate) fn ordered(&self) -> Option<Setting> {
        self.setting
    }

    /// Whether the camera can meter on its own.
    pub(crate) fn has_metering(&self) -> bool {
        self.metering.is_some()
    }

    /// True when the camera certainly meters on its own.
    pub(crate) fn is_metering(&self) -> bool {
        self.is_metering
    }

    /// Within how much the exposure time of the newest frame is known.
    pub(crate) fn unsure_ns(&self) -> u32 {
        if self.is_settling() { self.changed_ns } else { 0 }
    }

    fn is_settling(&self) -> bool {
        self.frames <= self.wanted.settle_frames
    }

    /// Carries out an order, and returns the exposure time that is set by it, in nanoseconds.
    ///
    /// # Errors
    /// The device's error.
    pub(crate) fn follow(
        &mut self,
        device: &impl Device,
        order: Order,
    ) -> std::io::Result<Option<u32>> {
        match order {
            Order::Keep => Ok(None),
            Order::OwnMetering => {
                let Some(value) = self.metering else { return Ok(None) };
                if self.is_metering && self.own_gain.is_none() {
                    return Ok(None);
                }
                self.setting = None;
                // Before the camera meters: it may refuse a gain that it then chooses on its own. It meters also with another
                // one.
                let put_back = self.put_gain_back(device);
                if !self.is_metering {
                    set(device, CID_EXPOSURE_AUTO, value)?;
                    self.is_metering = true;
                }
                put_back.map(|()| Some(0))
            }
            Order::TakeOver => {
                let exposure = control_value(device, CID_EXPOSURE_ABSOLUTE)?.unwrap_or(1);
                let value = self.gain.map(|gain| control_value(device, gain.id));
                let value = value.transpose()?.flatten();
                // One that could not be put back is still the camera's own.
                (self.own_gain, self.gain_refusals) = (self.own_gain.or(value), 0);
                let gain = self.gain.zip(value).map(|(gain, value)| self.factor(gain, value));
                if self.metering.is_some() {
                    set(device, CID_EXPOSURE_AUTO, EXPOSURE_MANUAL)?;
                    self.is_metering = false;
                }
                let exposure_s = f64::from(exposure.max(1)) * UNIT_S;
                let taken = self.set(device, Setting { exposure_s, gain: gain.unwrap_or(1.0) });
                if taken.is_err() {
                    // Neither would set it then. This answer adds nothing to the first refusal.
                    drop(self.follow(device, Order::OwnMetering));
                }
                taken.map(Some)
            }
            Order::Set(setting) => self.set(device, setting).map(Some),
        }
    }

    /// Sets the gain that the camera had. One that is refused is stored and tried again, a few times.
    fn put_gain_back(&mut self, device: &impl Device) -> std::io::Result<()> {
        let Some((gain, value)) = self.gain.zip(self.own_gain) else { return Ok(()) };
        let put_back = set(device, gain.id, value);
        self.gain_refusals += u32::from(put_back.is_err());
        if put_back.is_ok() || self.gain_refusals >= MAX_GAIN_REFUSALS {
            self.own_gain = None;
        }
        put_back
    }

    fn set(&mut self, device: &impl Device, setting: Setting) -> std::io::Result<u32> {
        let Limits { min_exposure_s, max_exposure_s, max_gain } = self.limits();
        let wanted_s = setting.exposure_s.clamp(min_exposure_s, max_exposure_s);
        let units = whole_units(wanted_s / UNIT_S, self.gain.is_some());
        let exposure_s = units * UNIT_S;
        // A few units are a rough measure: gain has the rest.
        let rest = wanted_s / exposure_s;
        let gain_wanted = if CLOSE.contains(&rest) { setting.gain } else { setting.gain * rest };
        let mut gain = 1.0;
        let control = self.gain.map(|control| {
            let Range { min, max } = control.range;
            let part = (gain_wanted.clamp(1.0, max_gain) - 1.0) / (max_gain - 1.0).max(1e-9);
            let value = min + (part * f64::from(max - min)).round() as i32;
            gain = self.factor(control, value);
            (control.id, value)
        });
        let next = Setting { exposure_s, gain };
        if self.setting == Some(next) {
            return Ok((exposure_s * 1e9).round() as u32);
        }
        set(device, CID_EXPOSURE_ABSOLUTE, units as i32)?;
        if let Some((id, value)) = control {
            set(device, id, value)?;
        }
        // The camera's choice before is not known.
        let change = |before: Setting| ((exposure_s - before.exposure_s).abs() * 1e9) as u32;
        self.changed_ns = self.setting.map_or(u32::MAX, change);
        self.setting = Some(next);
        (self.frames, self.ordered_ns) = (0, device.now_ns());
        Ok((exposure_s * 1e9).round() as u32)
    }

    /// How much brighter a value of the gain's control is than its smallest. Between the ends it is taken to be linear;
    /// where it is not, the loop needs more steps, and smaller ones.
    fn factor(&self, gain: Gain, value: i32) -> f64 {
        let Range { min, max } = gain.range;
        let part = f64::from(value - min) / f64::from((max - min).max(1));
        1.0 + part.clamp(0.0, 1.0) * (self.wanted.max_gain - 1.0)
    }
}

/// Whole units of exposure for so many: the nearest, or, where that is far off and gain can make up for it, those below.
fn whole_units(units: f64, has_gain: bool) -> f64 {
    let nearest = units.round().max(1.0);
    if has_gain && !CLOSE.contains(&(units / nearest)) {
        return units.floor().max(1.0);
    }
    nearest
}

fn set(device: &impl Device, id: u32, value: i32) -> std::io::Result<()> {
    let mut control = ExtControl { id, value, ..ExtControl::default() };
    device.call(Call::SetControl(&mut control))
}
