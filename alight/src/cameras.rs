//! `alight cameras`: lists the cameras of this machine with formats and sizes, and those announced over MAVLink with their video's
//! encoding and address, shows how to configure each, and takes a picture.

use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Duration;

use anyhow::{Context, anyhow, bail};
use camera_pub::{
    Announced, AnnouncedCamera, AnnouncedStream, Config, ConnectedDevice, DeviceDescription,
    SizeDescription, announced_cameras, connected_devices, source_table,
};
use clap::Args;
use node::Layers;
use serde::Serialize;

use crate::args::Format;
use crate::ending::png_file;
use crate::runtime::block_on;
use crate::terminal::{aligned, print};

mod picture;

/// Where the system has its devices.
const DEVICES: &str = "/dev";
/// Programs that write a camera's frames, and their purpose.
const PROGRAMS: [(&str, &str); 3] = [
    ("rpicam-vid", "Raspberry Pi cameras, with exact stamps"),
    ("gst-launch-1.0", "anything GStreamer reads, Jetson cameras among them"),
    ("ffmpeg", "streams"),
];
/// How long cameras may announce themselves over MAVLink and answer: they send a heartbeat each second.
const ASK_FOR: Duration = Duration::from_secs(5);
/// The hint below a table with a stream of RTSP.
const RTSP_HINT: &str = if cfg!(feature = "rtsp") {
    ""
} else {
    "# needs a program that was built with `--features rtsp`\n"
};
/// The optional features that concern cameras, and whether this program was built with each.
const FEATURES: [(&str, bool); 2] =
    [("rtsp", cfg!(feature = "rtsp")), ("genicam", cfg!(feature = "genicam"))];
/// Maximum number of sizes of a format that are listed for people.
const MAX_SIZES: usize = 6;

/// The arguments of `alight cameras`.
#[derive(Args)]
pub(crate) struct CamerasArgs {
    /// Take a picture (PNG), as a detector will get it, with the camera that is listed first, with `--device`, or with `--config`. Only
    /// while nothing else reads the camera.
    #[arg(long, value_name = "FILE.png", value_parser = png_file)]
    picture: Option<PathBuf>,
    /// Take the picture as camera-pub does with this configuration: its source, size and exposure.
    #[arg(long, value_name = "FILE", requires = "picture", conflicts_with = "device")]
    config: Option<PathBuf>,
    /// One setting over that configuration: dotted key, TOML value. May be repeated.
    #[arg(long, value_name = "KEY=VALUE", requires = "picture", conflicts_with = "device")]
    set: Vec<String>,
    /// Only this device.
    #[arg(long, value_name = "PATH")]
    device: Option<PathBuf>,
    /// Ask there for cameras that are announced over MAVLink as well, for 5 s: for example udpin:0.0.0.0:14550, or tcp:127.0.0.1:5762.
    #[arg(long, value_name = "ADDRESS", conflicts_with_all = ["picture", "device"])]
    mavlink: Option<String>,
    /// Format of the list: text, or one JSON object.
    #[arg(long, value_enum, default_value_t)]
    format: Format,
}

/// The cameras and the programs on this machine.
#[derive(Serialize)]
struct Listing {
    devices: Vec<Entry>,
    /// Cameras of GigE Vision and USB3 Vision.
    #[cfg(feature = "genicam")]
    genicam: Vec<camera_pub::GenicamCamera>,
    /// Cameras that are announced over MAVLink; `None` where they were not asked for.
    #[serde(skip_serializing_if = "Option::is_none")]
    mavlink: Option<Announced>,
    /// Programs that are on this machine.
    programs: Vec<&'static str>,
    /// Optional features with which this program was built.
    features: Vec<&'static str>,
}

/// A device, and how to configure it.
#[derive(Serialize)]
struct Entry {
    #[serde(flatten)]
    device: ConnectedDevice,
    /// The `[source]` table; `None` when camera-pub cannot read the device.
    source: Option<String>,
}

/// Lists the cameras, or takes a picture.
pub(crate) fn run(args: &CamerasArgs) -> anyhow::Result<ExitCode> {
    if let (Some(file), true) = (&args.picture, args.config.is_some() || !args.set.is_empty()) {
        let layers = Layers { file: args.config.clone(), set: args.set.clone() };
        return save_configured(&layers, file);
    }
    let folder = Path::new(DEVICES);
    let listing = listing(folder, args.device.as_deref());
    if let (Some(device), true) = (&args.device, listing.devices.is_empty()) {
        return Err(not_there(device, folder));
    }
    #[cfg(feature = "genicam")]
    let listing = Listing { genicam: camera_pub::genicam_cameras(), ..listing };
    let mavlink = match &args.mavlink {
        Some(address) => Some(block_on(announced_cameras(address, ASK_FOR))??),
        None => None,
    };
    let listing = Listing { mavlink, ..listing };
    if let Some(file) = &args.picture {
        return save_suggested(&listing, file);
    }
    match args.format {
        Format::Json => print(&serde_json::to_string(&listing)?)?,
        Format::Text => print(text(&listing).trim_end())?,
    }
    Ok(ExitCode::SUCCESS)
}

fn listing(folder: &Path, only: Option<&Path>) -> Listing {
    let mut found = connected_devices(folder);
    // A path in /dev/v4l/by-id is a link to the device.
    let only = only.map(|path| path.canonicalize().unwrap_or_else(|_| path.to_owned()));
    found.retain(|device| only.as_ref().is_none_or(|only| device.path == *only));
    let entry = |device: ConnectedDevice| {
        let description = device.description.as_ref();
        let path = device.link.as_ref().unwrap_or(&device.path);
        let source = description.and_then(|description| source_table(path, description));
        Entry { device, source }
    };
    let devices = found.into_iter().map(entry).collect();
    let programs = PROGRAMS.iter().map(|(name, _use)| *name).filter(|name| is_installed(name));
    Listing {
        devices,
        #[cfg(feature = "genicam")]
        genicam: Vec::new(),
        mavlink: None,
        programs: programs.collect(),
        features: built_in(),
    }
}

fn built_in() -> Vec<&'static str> {
    FEATURES.iter().filter(|(_, is_built_in)| *is_built_in).map(|(name, _)| *name).collect()
}

/// The error that a device is not one of those in a folder, which it lists.
fn not_there(device: &Path, folder: &Path) -> anyhow::Error {
    let others = listing(folder, None).devices;
    let names: Vec<String> =
        others.iter().map(|other| other.device.path.display().to_string()).collect();
    let there_is = match names.is_empty() {
        true => "no device of Video4Linux here".to_owned(),
        false => names.join(", "),
    };
    anyhow!("{} is no device of Video4Linux; there is {there_is}", device.display())
}

/// Whether a program is in one of the folders of `PATH`.
fn is_installed(program: &str) -> bool {
    let path = std::env::var_os("PATH").unwrap_or_default();
    std::env::split_paths(&path).any(|folder| folder.join(program).is_file())
}

fn text(listing: &Listing) -> String {
    let mut text = String::new();
    for Entry { device, source } in &listing.devices {
        let path = device.path.display();
        match (&device.description, &device.problem) {
            (Some(description), _) if description.is_camera => {
                text += &format!("{path}: {} ({})\n", description.card, description.driver);
                text += &modes(description);
                match source {
                    Some(source) => text += &format!("\n{source}\n"),
                    None => text += "  camera-pub reads none of these formats\n\n",
                }
            }
            (Some(description), _) if description.is_multi_planar => {
                text += &format!(
                    "{path}: {}, multi-planar, which camera-pub does not read: take GStreamer (docs/camera.md)\n\n",
                    description.card
                );
            }
            (Some(description), _) => {
                text += &format!("{path}: {}, gives no frames\n\n", description.card);
            }
            (None, problem) => {
                let problem = problem.as_deref().unwrap_or("no answer");
                text += &format!(
                    "{path}: {problem}; to open a camera, a user must be in the group `video`\n\n"
                );
            }
        }
    }
    #[cfg(feature = "genicam")]
    for camera_pub::GenicamCamera { name, vendor, model, address } in &listing.genicam {
        text +=
            &format!("{name}: {vendor} {model} at {address}\n\n[source]\ngenicam = {name:?}\n\n");
    }
    if let Some(Announced { cameras, problem }) = &listing.mavlink {
        text.extend(cameras.iter().map(announced_text));
        if let Some(problem) = problem {
            text += &format!("MAVLink: {problem}\n\n");
        } else if cameras.is_empty() {
            text += "MAVLink: no device at this address identifies itself as a camera; an autopilot in between must pass its packets on\n\n";
        }
    }
    if listing.devices.is_empty() {
        text += "No camera of Video4Linux: there is no /dev/video*. A USB camera appears there when it is plugged in; a Raspberry Pi \
                 camera is read by rpicam-vid (docs/camera.md).\n\n";
    }
    text += "Programs that camera-pub can read a camera with (`source.command`):\n";
    let row = |(name, purpose): &(&str, &str)| {
        let state = if listing.programs.contains(name) { "installed" } else { "not installed" };
        [format!("  {name}"), state.to_owned(), (*purpose).to_owned()]
    };
    text += &aligned(&PROGRAMS.each_ref().map(row));
    let row = |(name, is_built_in): &(&str, bool)| {
        let state = if *is_built_in { "built in" } else { "not built in" };
        [format!("  {name}"), state.to_owned()]
    };
    text + "\nOptional features of this program (`source.rtsp`, `source.genicam`):\n"
        + &aligned(&FEATURES.each_ref().map(row))
}

/// A camera that is announced over MAVLink, with the tables of its streams.
fn announced_text(camera: &AnnouncedCamera) -> String {
    let AnnouncedCamera { system, component, device, name, streams } = camera;
    let of_several = if *device > 0 { format!(", camera {device}") } else { String::new() };
    let name = if name.is_empty() { "a camera without a name" } else { name };
    let mut text = format!("MAVLink {system}/{component}{of_several}: {name}\n");
    if streams.is_empty() {
        text += "  it announces no video stream\n";
    }
    for AnnouncedStream { id, name, transport, encoding, address, size_px, rate_hz, source } in
        streams
    {
        let size = size_px.map(|[width, height]| format!("{width} x {height}"));
        let rate = rate_hz.map(|rate_hz| format!("at {rate_hz} Hz"));
        let parts = [
            Some(format!("{id}")),
            Some(name.clone()),
            Some((*transport).to_owned()),
            Some((*encoding).to_owned()),
            size,
            rate,
            Some(address.clone()),
        ];
        let parts: Vec<String> = parts.into_iter().flatten().filter(|it| !it.is_empty()).collect();
        text += &format!("  {}\n", parts.join(" "));
        match source {
            Some(source) => text += &format!("\n{source}\n{RTSP_HINT}\n"),
            None => {
                text +=
                    "  camera-pub cannot read it; ffmpeg may (`source.command`, docs/camera.md)\n";
            }
        }
    }
    text + "\n"
}

/// The formats of a device, one a line.
fn modes(description: &DeviceDescription) -> String {
    let size = |size: &SizeDescription| {
        let rates: Vec<_> = size.rates_hz.iter().map(|rate| format!("{rate:.0}")).collect();
        let up_to = if size.is_range { "up to " } else { "" };
        format!("{up_to}{} x {} at {} Hz", size.width, size.height, rates.join("/"))
    };
    let rows: Vec<_> = description
        .formats
        .iter()
        .map(|format| {
            let readable = if format.is_readable { "" } else { "(not read)" };
            let mut sizes: Vec<_> = format.sizes.iter().take(MAX_SIZES).map(size).collect();
            if format.sizes.len() > MAX_SIZES {
                sizes.push(format!("{} more", format.sizes.len() - MAX_SIZES));
            }
            [format!("  {}", format.fourcc), readable.to_owned(), sizes.join(", ")]
        })
        .collect();
    let controls: Vec<_> = description
        .controls
        .iter()
        .map(|control| format!("{} {} to {}", control.name, control.min, control.max))
        .collect();
    format!("{}  controls: {}\n", aligned(&rows), controls.join(", "))
}

/// Saves a picture of the first camera that can be read, in the mode that is suggested for it.
fn save_suggested(listing: &Listing, file: &Path) -> anyhow::Result<ExitCode> {
    let entry = listing.devices.iter().find_map(|entry| Some((entry, entry.source.as_ref()?)));
    let Some((entry, source)) = entry else {
        bail!("there is no camera that can be read; `alight cameras` lists what there is");
    };
    let folder = tempfile::tempdir().context("making a folder for the configuration")?;
    let path = folder.path().join("camera.toml");
    // The camera's own metering is kept for a picture: a table is for flight.
    let table: String = source
        .lines()
        .filter(|line| !line.starts_with("controls"))
        .map(|line| format!("{line}\n"))
        .collect();
    std::fs::write(&path, table).with_context(|| format!("writing {path:?}"))?;
    let layers = Layers { file: Some(path), set: Vec::new() };
    save(&layers, file, |_config| entry.device.path.display().to_string())
}

/// Saves a picture of the camera with this configuration.
fn save_configured(layers: &Layers, file: &Path) -> anyhow::Result<ExitCode> {
    save(layers, file, |config| format!("camera `{}`", config.instance()))
}

/// Saves a picture as camera-pub publishes it with a configuration, by which its camera is named.
fn save(
    layers: &Layers,
    file: &Path,
    name: impl Fn(&Config) -> String,
) -> anyhow::Result<ExitCode> {
    node::start_logging("warn");
    let config = layers.load::<Config>()?.settings;
    let of = name(&config);
    let picture = picture::published(config)?;
    let [width, height] = [picture.width() as u32, picture.height() as u32];
    image::save_buffer(file, picture.pixels(), width, height, image::ExtendedColorType::L8)
        .with_context(|| format!("writing the picture {file:?}"))?;
    print(&format!("{}: {width} x {height} pixels of {of}", file.display()))?;
    Ok(ExitCode::SUCCESS)
}

#[cfg(test)]
mod tests {
    use super::*;
    use camera_pub::{ControlDescription, FormatDescription};

    fn entry(formats: &[(&str, bool)], is_camera: bool) -> Entry {
        let size = SizeDescription {
            width: 1280,
            height: 720,
            is_range: false,
            rates_hz: vec![60.0, 30.0],
        };
        let formats = formats
            .iter()
            .map(|(fourcc, is_readable)| FormatDescription {
                fourcc: (*fourcc).to_owned(),
                name: String::new(),
                is_readable: *is_readable,
                sizes: vec![size.clone()],
            })
            .collect();
        let description = DeviceDescription {
            driver: "uvcvideo".into(),
            card: "PTZ Pro Camera".into(),
            bus: "usb-0000:0e:00.0-2.4".into(),
            is_camera,
            is_multi_planar: false,
            formats,
            controls: Vec::<ControlDescription>::new(),
        };
        let path = PathBuf::from("/dev/video0");
        let source = source_table(&path, &description);
        let device =
            ConnectedDevice { path, link: None, description: Some(description), problem: None };
        Entry { device, source }
    }

    #[test]
    fn a_camera_is_listed_with_a_table_to_paste() {
        let formats = [("MJPG", true), ("H264", false)];
        let listing = Listing {
            devices: vec![entry(&formats, true)],
            #[cfg(feature = "genicam")]
            genicam: Vec::new(),
            mavlink: None,
            programs: vec!["ffmpeg"],
            features: built_in(),
        };
        let text = text(&listing);
        assert!(text.contains("/dev/video0: PTZ Pro Camera (uvcvideo)"), "{text}");
        assert!(text.contains("1280 x 720 at 60/30 Hz") && text.contains("(not read)"), "{text}");
        assert!(text.contains("[source]\ndevice = \"/dev/video0\"\nfourcc = \"MJPG\""), "{text}");
        let json = serde_json::to_value(&listing).unwrap();
        assert_eq!(json["devices"][0]["path"], "/dev/video0");
        assert_eq!(json["devices"][0]["description"]["formats"][1]["is_readable"], false);
        assert_eq!(json["programs"][0], "ffmpeg");
        for (name, is_built_in) in FEATURES {
            let state = if is_built_in { "built in" } else { "not built in" };
            let rows =
                text.lines().map(|line| line.split_whitespace().collect::<Vec<_>>().join(" "));
            assert!(rows.clone().any(|row| row == format!("{name} {state}")), "{text}");
            let listed = json["features"].as_array().unwrap().iter().any(|it| it == name);
            assert_eq!(listed, is_built_in, "{name}");
        }
    }

    #[test]
    fn a_machine_without_cameras_is_reported_with_the_remedy() {
        let folder = tempfile::tempdir().unwrap();
        let listing = listing(folder.path(), None);
        let text = text(&listing);
        assert!(text.contains("No camera of Video4Linux: there is no /dev/video*"), "{text}");
        assert!(text.contains("rpicam-vid") && text.contains("`source.command`"), "{text}");
        let problem = save_suggested(&listing, Path::new("unused.png")).unwrap_err().to_string();
        assert!(problem.contains("no camera that can be read"), "{problem}");
    }

    #[test]
    fn a_missing_device_is_reported_with_those_that_are_there() {
        let folder = tempfile::tempdir().unwrap();
        let message = |device: &str| not_there(Path::new(device), folder.path()).to_string();
        assert!(message("/dev/video77").contains("no device of Video4Linux here"));
        std::fs::write(folder.path().join("video0"), "").unwrap();
        let message = message("/dev/video77");
        assert!(message.contains("/dev/video77") && message.contains("video0"), "{message}");
    }

    #[test]
    fn a_device_without_frames_has_no_table() {
        for other in [entry(&[], false), entry(&[("H264", false)], true)] {
            assert_eq!(other.source, None);
            let listing = Listing {
                devices: vec![other],
                #[cfg(feature = "genicam")]
                genicam: Vec::new(),
                mavlink: None,
                programs: Vec::new(),
                features: Vec::new(),
            };
            let text = text(&listing);
            assert!(text.contains("gives no frames") || text.contains("none of these"), "{text}");
        }
    }
}
