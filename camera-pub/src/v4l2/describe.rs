//! Lists a device's name, pixel formats, sizes, rates and controls.

use std::io;

use serde::Serialize;

use super::abi::{
    CAP_DEVICE_CAPS, CAP_STREAMING, CAP_VIDEO_CAPTURE, CAP_VIDEO_CAPTURE_MPLANE,
    CTRL_FLAG_DISABLED, CTRL_FLAG_NEXT_CTRL, CTRL_FLAG_READ_ONLY, Call, Capability, Device,
    ExtControl, FmtDesc, FrmIvalEnum, FrmSizeEnum, QueryExtCtrl, TYPE_DISCRETE, VIDEO_CAPTURE,
    text,
};
use super::pixels::Pixels;

/// Maximum number of entries of one kind: a driver that does not end its list is not read for ever.
const MAX_ENTRIES: u32 = 256;

/// A video device.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct DeviceDescription {
    /// The driver, as `uvcvideo`.
    pub driver: String,
    /// The camera's name.
    pub card: String,
    /// Where it is connected.
    pub bus: String,
    /// True for a device that gives frames. A camera has further devices for its metadata.
    pub is_camera: bool,
    /// True for a device that gives frames in several planes, each in memory of its own, which camera-pub does not read.
    pub is_multi_planar: bool,
    /// Its pixel formats.
    pub formats: Vec<FormatDescription>,
    /// Its controls.
    pub controls: Vec<ControlDescription>,
}

/// A pixel format of a device.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct FormatDescription {
    /// Its four letters.
    pub fourcc: String,
    /// Its name by the driver.
    pub name: String,
    /// True when camera-pub reads it.
    pub is_readable: bool,
    /// Its frame sizes.
    pub sizes: Vec<SizeDescription>,
}

/// A frame size of a pixel format.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SizeDescription {
    /// Its width in pixels; the largest of a range.
    pub width: u32,
    /// Its height in pixels; the largest of a range.
    pub height: u32,
    /// True when smaller sizes are possible as well.
    pub is_range: bool,
    /// Its frame rates, the highest first.
    pub rates_hz: Vec<f64>,
}

/// A control of a device.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ControlDescription {
    /// Its name, in lower-case letters, digits and `_`.
    pub name: String,
    /// Its smallest value.
    pub min: i64,
    /// Its largest value.
    pub max: i64,
    /// Its value at first.
    pub default: i64,
    #[serde(skip)]
    pub(crate) id: u32,
    #[serde(skip)]
    pub(crate) is_writable: bool,
}

/// Queries a device's capabilities.
///
/// # Errors
/// It is not a video device, or is gone.
pub(crate) fn describe(device: &impl Device) -> io::Result<DeviceDescription> {
    let mut capability = Capability::default();
    device.call(Call::QueryCap(&mut capability))?;
    let is_camera = is_camera(&capability);
    Ok(DeviceDescription {
        driver: text(&capability.driver),
        card: text(&capability.card),
        bus: text(&capability.bus_info),
        is_camera,
        is_multi_planar: is_multi_planar(&capability),
        formats: if is_camera { formats(device)? } else { Vec::new() },
        controls: if is_camera { controls(device)? } else { Vec::new() },
    })
}

/// True for a device that gives frames in buffers that can be mapped.
pub(crate) fn is_camera(capability: &Capability) -> bool {
    let caps = caps(capability);
    caps & CAP_VIDEO_CAPTURE != 0 && caps & CAP_STREAMING != 0
}

/// True for a device that gives frames in several planes, and in no other way.
pub(crate) fn is_multi_planar(capability: &Capability) -> bool {
    caps(capability) & CAP_VIDEO_CAPTURE_MPLANE != 0 && !is_camera(capability)
}

/// The capabilities of a node, where the driver reports them; else those of all nodes of its device.
fn caps(capability: &Capability) -> u32 {
    let has_own = capability.capabilities & CAP_DEVICE_CAPS != 0;
    if has_own { capability.device_caps } else { capability.capabilities }
}

/// The entries of a list that `EINVAL` ends.
fn entries<T>(mut entry: impl FnMut(u32) -> io::Result<T>) -> io::Result<Vec<T>> {
    let mut found = Vec::new();
    for index in 0..MAX_ENTRIES {
        match entry(index) {
            Ok(entry) => found.push(entry),
            Err(end) if is_end(&end) => break,
            Err(cause) => return Err(cause),
        }
    }
    Ok(found)
}

/// The end of a list, or a list that the driver has not.
fn is_end(cause: &io::Error) -> bool {
    matches!(cause.raw_os_error(), Some(libc::EINVAL | libc::ENOTTY | libc::ENODATA))
}

fn formats(device: &impl Device) -> io::Result<Vec<FormatDescription>> {
    entries(|index| {
        let mut format = FmtDesc { index, kind: VIDEO_CAPTURE, ..FmtDesc::default() };
        device.call(Call::EnumFmt(&mut format))?;
        let fourcc = text(&format.pixelformat.to_le_bytes());
        Ok(FormatDescription {
            is_readable: Pixels::of(&fourcc).is_some(),
            fourcc,
            name: text(&format.description),
            sizes: sizes(device, format.pixelformat)?,
        })
    })
}

fn sizes(device: &impl Device, pixel_format: u32) -> io::Result<Vec<SizeDescription>> {
    let mut has_ended = false;
    let mut sizes = entries(|index| {
        if has_ended {
            return Err(io::Error::from_raw_os_error(libc::EINVAL));
        }
        let mut size = FrmSizeEnum { index, pixel_format, ..FrmSizeEnum::default() };
        device.call(Call::EnumFrameSizes(&mut size))?;
        // A range is one entry, whatever the next index answers.
        has_ended = size.kind != TYPE_DISCRETE;
        let [first, second, _, _, max_height, _] = size.size;
        // Discrete: width, height. Range: minimum, maximum and step of the width, then of the height.
        let (width, height) = if has_ended { (second, max_height) } else { (first, second) };
        let rates_hz = rates_hz(
            device,
            &FrmIvalEnum { pixel_format, width, height, ..FrmIvalEnum::default() },
        )?;
        Ok(SizeDescription { width, height, is_range: has_ended, rates_hz })
    })?;
    // Drivers list some twice.
    let mut seen = Vec::new();
    sizes.retain(|size| {
        let edges = (size.width, size.height);
        let is_new = !seen.contains(&edges);
        seen.push(edges);
        is_new
    });
    Ok(sizes)
}

fn rates_hz(device: &impl Device, of: &FrmIvalEnum) -> io::Result<Vec<f64>> {
    let mut has_ended = false;
    let mut rates = entries(|index| {
        if has_ended {
            return Err(io::Error::from_raw_os_error(libc::EINVAL));
        }
        let mut interval = FrmIvalEnum { index, ..of.clone() };
        device.call(Call::EnumFrameIntervals(&mut interval))?;
        has_ended = interval.kind != TYPE_DISCRETE;
        // Of a range the smallest interval, which comes first.
        let [numerator, denominator, ..] = interval.interval;
        Ok(f64::from(denominator) / f64::from(numerator.max(1)))
    })?;
    rates.sort_by(|a, b| b.total_cmp(a));
    rates.dedup();
    Ok(rates)
}

/// The controls of a device.
///
/// # Errors
/// The device is gone.
pub(crate) fn controls(device: &impl Device) -> io::Result<Vec<ControlDescription>> {
    let mut last_id = 0;
    let found = entries(|_index| {
        let id = last_id | CTRL_FLAG_NEXT_CTRL;
        let mut control = QueryExtCtrl { id, ..QueryExtCtrl::default() };
        device.call(Call::QueryExtCtrl(&mut control))?;
        if control.id <= last_id {
            // A driver that does not advance would be queried for ever.
            return Err(io::Error::from_raw_os_error(libc::EINVAL));
        }
        last_id = control.id;
        Ok(control)
    })?;
    let is_value = |control: &&QueryExtCtrl| {
        control.flags & CTRL_FLAG_DISABLED == 0 && (1..=3).contains(&control.kind)
    };
    let described = found.iter().filter(is_value).map(|control| ControlDescription {
        name: control_name(&text(&control.name)),
        min: control.minimum,
        max: control.maximum,
        default: control.default_value,
        id: control.id,
        is_writable: control.flags & CTRL_FLAG_READ_ONLY == 0,
    });
    Ok(described.collect())
}

/// A control's name as other tools write it: `Exposure Time, Absolute` is `exposure_time_absolute`.
fn control_name(name: &str) -> String {
    let words = name.split(|c: char| !c.is_ascii_alphanumeric()).filter(|word| !word.is_empty());
    words.map(str::to_ascii_lowercase).collect::<Vec<_>>().join("_")
}

/// The present value of a control; `None` where the device has it not.
///
/// # Errors
/// It cannot be read now.
pub(crate) fn control_value(device: &impl Device, id: u32) -> io::Result<Option<i32>> {
    let mut control = ExtControl { id, ..ExtControl::default() };
    match device.call(Call::GetControl(&mut control)) {
        Ok(()) => Ok(Some(control.value)),
        Err(cause) if matches!(cause.raw_os_error(), Some(libc::EINVAL | libc::ENOTTY)) => Ok(None),
        Err(cause) => Err(cause),
    }
}
