//! Lists the video devices of this machine, their formats and controls, and how to configure them.

use std::path::{Path, PathBuf};

use serde::Serialize;

use crate::v4l2::abi::{CID_EXPOSURE_ABSOLUTE, CID_EXPOSURE_AUTO, EXPOSURE_MANUAL};
use crate::v4l2::describe::{DeviceDescription, FormatDescription, SizeDescription, describe};
use crate::v4l2::kernel::KernelDevice;
use crate::v4l2::pixels::Pixels;

/// A video device of this machine.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ConnectedDevice {
    /// Its path, as `/dev/video0`.
    pub path: PathBuf,
    /// A link to it, where there is one: its number may be another camera's when it is plugged in again.
    pub link: Option<PathBuf>,
    /// Its formats and controls; `None` when it cannot be queried.
    pub description: Option<DeviceDescription>,
    /// Why it cannot be queried.
    pub problem: Option<String>,
}

/// Exposure time that is suggested, in 100 us: it blurs by a pixel at a turn of 30 degrees per second and 1000 pixels of
/// focal length.
const SUGGESTED_EXPOSURE: i64 = 20;
/// Minimum frame rate that is suggested.
const MIN_RATE_HZ: f64 = 25.0;
/// Maximum pixels of frames that are suggested: more cost the detector more time than they add range.
const MAX_PIXELS: u64 = 1920 * 1200;

/// The video devices in this folder, which is `/dev`, in the order of their numbers.
pub fn connected_devices(folder: &Path) -> Vec<ConnectedDevice> {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    let number = |path: &PathBuf| -> Option<u32> {
        path.file_name()?.to_str()?.strip_prefix("video")?.parse().ok()
    };
    let mut found: Vec<(u32, PathBuf)> =
        entries.map(|entry| entry.path()).filter_map(|path| Some((number(&path)?, path))).collect();
    found.sort();
    let mut devices: Vec<_> = found.into_iter().map(|(_number, path)| query(path)).collect();
    let name = |device: &ConnectedDevice| {
        device.description.as_ref().filter(|it| it.is_camera).map(|it| it.card.clone())
    };
    let names: Vec<_> = devices.iter().filter_map(name).collect();
    for device in &mut devices {
        let of_its_name = |own: String| names.iter().filter(|name| **name == own).count();
        let has_twin = name(device).is_some_and(|own| of_its_name(own) > 1);
        device.link = lasting_link(folder, &device.path, has_twin);
    }
    devices
}

/// The link to a device in `v4l/by-id`, which stays with it wherever it is plugged in, or that in `v4l/by-path`, which is of its
/// place: cameras of one name may have the same id.
fn lasting_link(folder: &Path, path: &Path, has_twin: bool) -> Option<PathBuf> {
    let device = path.canonicalize().ok()?;
    let kinds = if has_twin { &["by-path"][..] } else { &["by-id", "by-path"] };
    kinds.iter().find_map(|kind| {
        let links = std::fs::read_dir(folder.join("v4l").join(kind)).ok()?.flatten();
        let is_its = |link: &PathBuf| link.canonicalize().is_ok_and(|target| target == device);
        links.map(|link| link.path()).filter(is_its).min()
    })
}

fn query(path: PathBuf) -> ConnectedDevice {
    match KernelDevice::open(&path).and_then(|device| describe(&device)) {
        Ok(description) => {
            ConnectedDevice { path, link: None, description: Some(description), problem: None }
        }
        Err(cause) => {
            let problem = Some(cause.to_string());
            ConnectedDevice { path, link: None, description: None, problem }
        }
    }
}

/// The `[source]` table with which camera-pub reads a device; `None` when it reads none of its formats.
pub fn source_table(path: &Path, description: &DeviceDescription) -> Option<String> {
    let (format, size) = best_mode(description)?;
    let rate_hz = suggested_rate_hz(size);
    let mut table = format!(
        "[source]\ndevice = {path:?}\nfourcc = \"{}\"\nsize_px = [{}, {}]\nrate_hz = {rate_hz:.1}\n",
        format.fourcc, size.width, size.height
    );
    // By their numbers: their names have changed between versions of Linux.
    let control = |id| description.controls.iter().find(|control| control.id == id);
    if let (Some(auto), Some(exposure)) =
        (control(CID_EXPOSURE_AUTO), control(CID_EXPOSURE_ABSOLUTE))
    {
        let value = SUGGESTED_EXPOSURE.clamp(exposure.min, exposure.max.max(exposure.min));
        let controls =
            format!("[\"{}={EXPOSURE_MANUAL}\", \"{}={value}\"]", auto.name, exposure.name);
        let ms = value as f64 * 0.1;
        table += &format!("# {ms:.1} ms: short, so that nothing blurs, and stamps are exact.\n");
        table += &format!("controls = {controls}\n");
    }
    Some(table)
}

/// The mode that is suggested: fast enough, then of most pixels, then without loss.
fn best_mode(description: &DeviceDescription) -> Option<(&FormatDescription, &SizeDescription)> {
    let readable = description.formats.iter().filter(|format| format.is_readable);
    let modes = readable.flat_map(|format| format.sizes.iter().map(move |size| (format, size)));
    modes.max_by_key(|(format, size)| {
        let pixels = u64::from(size.width) * u64::from(size.height);
        let is_fast = suggested_rate_hz(size) >= MIN_RATE_HZ;
        let preference = Pixels::ALL.iter().rev().position(|(fourcc, _)| *fourcc == format.fourcc);
        // Of those that are all too large the smallest.
        let order =
            if pixels <= MAX_PIXELS { pixels } else { MAX_PIXELS / (pixels / MAX_PIXELS + 1) };
        (is_fast && pixels <= MAX_PIXELS, is_fast, order, preference)
    })
}

/// The highest rate up to 60 Hz, beyond which a detector may not follow, or the lowest.
fn suggested_rate_hz(size: &SizeDescription) -> f64 {
    let fitting = size.rates_hz.iter().copied().filter(|rate| *rate <= 60.5).reduce(f64::max);
    fitting.or_else(|| size.rates_hz.iter().copied().reduce(f64::min)).unwrap_or(30.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Config;
    use crate::v4l2::fake::{Fake, Stamps};
    use crate::v4l2::video::Port;
    use node::Layers;

    /// The configuration with this `[source]` table.
    fn config(table: &str) -> Config {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), table).unwrap();
        let layers = Layers { file: Some(file.path().to_owned()), set: Vec::new() };
        layers.load::<Config>().unwrap().settings
    }

    fn description(sizes: &[(&str, u32, u32, f64)]) -> DeviceDescription {
        let fake = Fake::of("MJPG", Stamps::ExposureStart, 0);
        let mut description = describe(&fake.open().unwrap()).unwrap();
        description.formats = sizes
            .iter()
            .map(|(fourcc, width, height, rate_hz)| FormatDescription {
                fourcc: (*fourcc).to_owned(),
                name: String::new(),
                is_readable: Pixels::of(fourcc).is_some(),
                sizes: vec![SizeDescription {
                    width: *width,
                    height: *height,
                    is_range: false,
                    rates_hz: vec![*rate_hz],
                }],
            })
            .collect();
        description
    }

    #[test]
    fn the_suggested_table_is_a_configuration() {
        let description = description(&[
            ("YUYV", 1280, 720, 10.0),
            ("H264", 1920, 1080, 60.0),
            ("MJPG", 1280, 720, 60.0),
            ("YUYV", 640, 480, 30.0),
            ("MJPG", 3840, 2160, 30.0),
        ]);
        let table = source_table(Path::new("/dev/video2"), &description).unwrap();
        let device = config(&table).device().unwrap().unwrap();
        assert_eq!(device.path, Path::new("/dev/video2"));
        let wanted = device.wanted;
        assert_eq!((&*wanted.fourcc, wanted.width, wanted.rate_hz), ("MJPG", 1280, 60.0));
        assert_eq!(wanted.controls.len(), 2);
    }

    #[test]
    fn the_fastest_without_loss_goes_before_jpeg_of_the_same_size() {
        let of = |sizes: &[(&str, u32, u32, f64)]| {
            let description = description(sizes);
            let mode = best_mode(&description);
            mode.map(|(format, size)| format!("{} {}", format.fourcc, size.width))
        };
        let both = [("MJPG", 1280, 800, 120.0), ("GREY", 1280, 800, 60.0)];
        assert_eq!(of(&both).unwrap(), "GREY 1280");
        assert_eq!(
            of(&[("MJPG", 1280, 720, 30.0), ("GREY", 1280, 720, 5.0)]).unwrap(),
            "MJPG 1280"
        );
        assert_eq!(of(&[("H264", 1280, 720, 30.0)]), None);
        assert_eq!(of(&[("YUYV", 4000, 3000, 5.0)]).unwrap(), "YUYV 4000");
    }

    #[test]
    fn a_device_is_named_by_a_link_that_stays_with_it() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        std::fs::create_dir_all(at("v4l/by-id")).unwrap();
        std::fs::create_dir_all(at("v4l/by-path")).unwrap();
        for name in ["video0", "video2", "video4"] {
            std::fs::write(at(name), "").unwrap();
        }
        for (link, device) in
            [("by-id/usb-a", "video0"), ("by-path/usb-1", "video0"), ("by-path/usb-2", "video2")]
        {
            std::os::unix::fs::symlink(at(device), at("v4l").join(link)).unwrap();
        }
        let link = |name, has_twin| lasting_link(folder.path(), &at(name), has_twin);
        assert_eq!(link("video0", false).unwrap(), at("v4l/by-id/usb-a"));
        assert_eq!(link("video0", true).unwrap(), at("v4l/by-path/usb-1"));
        assert_eq!(link("video2", false).unwrap(), at("v4l/by-path/usb-2"));
        assert_eq!(link("video4", false), None);
    }

    #[test]
    fn devices_are_listed_by_their_numbers_with_their_errors() {
        let folder = tempfile::tempdir().unwrap();
        for name in ["video10", "video2", "videodev", "null"] {
            std::fs::write(folder.path().join(name), "").unwrap();
        }
        let found = connected_devices(folder.path());
        let names: Vec<_> = found.iter().filter_map(|device| device.path.file_name()).collect();
        assert_eq!(names, ["video2", "video10"]);
        assert!(found.iter().all(|d| d.problem.as_ref().unwrap().contains("ioctl")), "{found:?}");
    }
}
