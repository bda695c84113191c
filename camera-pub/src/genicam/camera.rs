//! Opens a GenICam camera with Aravis, sets its region, format, rate and features, and takes its buffers with stamps and
//! exposure time, counting those that were not delivered.
#![allow(unsafe_code, reason = "the bytes of a buffer are behind a pointer; nothing else is here")]

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use anyhow::{Context, bail, ensure};
use aravis::prelude::*;
use aravis::{Aravis, Auto, Buffer, BufferStatus, Camera, Stream};
use imaging::BayerPattern;
use node::now_ns;
use serde::Serialize;

use crate::clock::{CameraClock, UtcArrivals};
use crate::config::{FrameSize, GenicamConfig};
use crate::control::Configured;
use crate::exposure::{Exposure, Shutter, StampedAt};

/// Number of frames that Aravis may hold.
const BUFFERS: usize = 8;
/// Maximum bytes of a frame besides its pixels: chunks.
const MAX_EXTRA_BYTES: usize = 1 << 20;

/// A camera of GenICam that answers.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct GenicamCamera {
    /// Its name for `source.genicam`.
    pub name: String,
    /// Its manufacturer.
    pub vendor: String,
    /// Its model.
    pub model: String,
    /// Its address on the network or the bus.
    pub address: String,
}

/// The available cameras of GenICam. It takes about a second, as they are queried over the network.
pub fn genicam_cameras() -> Vec<GenicamCamera> {
    // Aravis' list is one for the whole process.
    static ARAVIS: OnceLock<Option<Mutex<Aravis>>> = OnceLock::new();
    let Some(aravis) = ARAVIS.get_or_init(|| Aravis::initialize().ok().map(Mutex::new)) else {
        return Vec::new();
    };
    let devices = aravis.lock().unwrap_or_else(PoisonError::into_inner).get_device_list();
    let text = |it: std::ffi::CString| it.to_string_lossy().into_owned();
    devices
        .into_iter()
        .filter(|device| device.protocol.as_bytes() != b"Fake")
        .map(|device| GenicamCamera {
            name: text(device.id),
            vendor: text(device.vendor),
            model: text(device.model),
            address: text(device.address),
        })
        .collect()
}

/// A camera that sends frames.
pub(super) struct OpenCamera {
    camera: Camera,
    stream: Stream,
    clock: CameraClock,
    arrivals: UtcArrivals,
    shutter: Shutter,
    delay_ns: i64,
    /// The exposure time, where the camera does not change it automatically.
    exposure_ns: Option<u32>,
    /// Whether it reports that it changes the exposure time automatically.
    is_metering: bool,
    size: FrameSize,
    is_gone: Arc<AtomicBool>,
    counts: Counts,
}

/// Frames that were not delivered.
#[derive(Copy, Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct Counts {
    /// Of which packets were lost.
    pub(crate) torn: u64,
    /// Of another size or format.
    pub(crate) other: u64,
    /// That waited until a newer one was there.
    pub(crate) queued: u64,
}

/// A frame.
pub(crate) struct Taken {
    buffer: Buffer,
    /// When it was exposed.
    pub(crate) exposure: Exposure,
}

impl Taken {
    /// Its stamp, by the camera's clock, in nanoseconds.
    #[cfg(test)]
    pub(super) fn stamp_ns(&self) -> i64 {
        self.buffer.timestamp().cast_signed()
    }

    /// Its pixels.
    pub(crate) fn pixels(&self) -> &[u8] {
        let (start, len) = self.buffer.data();
        if start.is_null() {
            return &[];
        }
        // SAFETY: Aravis' buffers own this many bytes, written before the buffer was taken from the stream, and this one is ours
        // until it is given back, which takes it.
        unsafe { std::slice::from_raw_parts(start, len) }
    }
}

impl OpenCamera {
    /// Opens a camera, sets it up, and has it send.
    ///
    /// # Errors
    /// When it does not answer, or does not support the configuration.
    pub(super) fn start(config: &GenicamConfig) -> anyhow::Result<Self> {
        let name = Some(config.name.as_str()).filter(|name| *name != "any");
        let camera = Camera::new(name).map_err(|problem| {
            anyhow::anyhow!(
                "the camera does not answer ({problem}); `alight cameras` lists those that do"
            )
        })?;
        let device = camera.device().context("the camera has no device")?;
        let set_features = || {
            config.features.iter().try_for_each(|feature| {
                let set = device.set_features_from_string(feature);
                set.with_context(|| format!("setting `{feature}` of `source.controls`"))
            })
        };
        // Binning changes which sizes there are.
        set_features()?;
        set_format(&camera, config.bayer)?;
        set_region(&camera, config.size)?;
        camera.set_frame_rate(config.rate_hz).with_context(|| {
            let bounds = camera.frame_rate_bounds();
            let bounds =
                bounds.map(|(min, max)| format!(", which can be from {min:.2} to {max:.2} now"));
            format!("setting `source.rate_hz` to {}{}", config.rate_hz, bounds.unwrap_or_default())
        })?;
        // Setting the rate resets the trigger.
        set_features()?;
        let is_metering = camera.exposure_time_auto().is_ok_and(|auto| auto != Auto::Off);
        let exposure_us = camera.exposure_time().ok().filter(|_| !is_metering);
        let payload = camera.payload().context("asking for the size of frames")? as usize;
        ensure!(
            (config.size.pixels()..=config.size.pixels() + MAX_EXTRA_BYTES).contains(&payload),
            "its frames have {payload} bytes, and {} pixels of a byte each are wanted",
            config.size.pixels()
        );
        let stream = camera.create_stream().context("opening the stream of frames")?;
        for _ in 0..BUFFERS {
            stream.push_buffer(Buffer::new_allocate(payload));
        }
        let is_gone = Arc::new(AtomicBool::new(false));
        let gone = Arc::clone(&is_gone);
        device.connect_control_lost(move |_| gone.store(true, Ordering::Relaxed));
        camera.start_acquisition().context("having the camera send frames")?;
        Ok(Self {
            camera,
            stream,
            clock: CameraClock::direct(),
            arrivals: UtcArrivals::default(),
            shutter: config.shutter,
            delay_ns: config.delay_ns,
            exposure_ns: exposure_us.map(|us| (us * 1e3).clamp(1.0, f64::from(u32::MAX)) as u32),
            is_metering,
            size: config.size,
            is_gone,
            counts: Counts::default(),
        })
    }

    /// How the camera is exposed; `None` where it does not report that.
    pub(super) fn configured(&self) -> Option<Configured> {
        match self.exposure_ns {
            Some(exposure_ns) => Some(Configured::Fixed { exposure_ns }),
            None => self.is_metering.then_some(Configured::Metering),
        }
    }

    /// Whether the camera has stopped to answer.
    pub(super) fn is_gone(&self) -> bool {
        self.is_gone.load(Ordering::Relaxed)
    }

    /// The newest complete frame that arrives within this time.
    pub(super) fn take(&mut self, timeout: Duration) -> Option<Taken> {
        let mut newest: Option<Buffer> = None;
        // A reader that needs more than a period for a frame would otherwise get the oldest, after all buffers have filled.
        for taken in 0..BUFFERS {
            let popped = match taken {
                0 => self.stream.timeout_pop_buffer(timeout.as_micros() as u64),
                _ => self.stream.try_pop_buffer(),
            };
            let Some(buffer) = popped else { break };
            let refused = if self.is_complete(&buffer) {
                let older = newest.replace(buffer);
                self.counts.queued += u64::from(older.is_some());
                older
            } else {
                Some(buffer)
            };
            if let Some(refused) = refused {
                self.stream.push_buffer(refused);
            }
        }
        let buffer = newest?;
        let exposure = self.exposure(&buffer);
        Some(Taken { buffer, exposure })
    }

    /// Whether a buffer has all of a frame as it is wanted; another is counted.
    fn is_complete(&mut self, buffer: &Buffer) -> bool {
        if buffer.status() != BufferStatus::Success {
            self.counts.torn += 1;
            return false;
        }
        let edges = [buffer.image_width(), buffer.image_height()].map(usize::try_from);
        let is_wanted = edges == [Ok(self.size.width), Ok(self.size.height)]
            && buffer.data().1 >= self.size.pixels();
        self.counts.other += u64::from(!is_wanted);
        is_wanted
    }

    /// Gives a frame back, to be filled again.
    pub(super) fn give_back(&mut self, taken: Taken) {
        self.stream.push_buffer(taken.buffer);
    }

    /// The counts of frames that were not delivered since the last call.
    pub(super) fn take_counts(&mut self) -> Counts {
        std::mem::take(&mut self.counts)
    }

    /// When a frame's first packet arrived, by the host's clock. Aravis gives it by the system's, which may be set.
    fn arrival_ns(&mut self, buffer: &Buffer) -> i64 {
        let utc = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        let utc_ns = i64::try_from(utc.as_nanos()).unwrap_or(i64::MAX);
        self.arrivals.host_ns(buffer.system_timestamp().cast_signed(), utc_ns, now_ns())
    }

    /// When a frame was exposed: by the camera's stamp, or by its arrival while that is not understood.
    fn exposure(&mut self, buffer: &Buffer) -> Exposure {
        let arrival_ns = self.arrival_ns(buffer);
        let exposure_ns = self.exposure_ns.unwrap_or(0);
        let until_sent_ns = self.delay_ns
            + match self.shutter.stamped_at {
                StampedAt::ExposureStart => i64::from(exposure_ns),
                StampedAt::ReadoutStart | StampedAt::FrameEnd => 0,
            };
        let stamp_ns = i64::try_from(buffer.timestamp()).ok().filter(|stamp_ns| *stamp_ns > 0);
        let host_ns =
            stamp_ns.and_then(|stamp_ns| self.clock.host_ns(stamp_ns, until_sent_ns, arrival_ns));
        match (host_ns, self.exposure_ns) {
            (Some(host_ns), Some(exposure_ns)) => {
                Exposure { mid_ns: self.shutter.mid_exposure_ns(host_ns, exposure_ns), exposure_ns }
            }
            _ => Exposure::estimated(arrival_ns - self.delay_ns - i64::from(exposure_ns) / 2),
        }
    }
}

impl Drop for OpenCamera {
    fn drop(&mut self) {
        // It may be gone.
        let _ = self.camera.stop_acquisition();
    }
}

fn set_format(camera: &Camera, bayer: Option<BayerPattern>) -> anyhow::Result<()> {
    let format = match bayer {
        None => "Mono8",
        Some(BayerPattern::Rggb) => "BayerRG8",
        Some(BayerPattern::Grbg) => "BayerGR8",
        Some(BayerPattern::Gbrg) => "BayerGB8",
        Some(BayerPattern::Bggr) => "BayerBG8",
    };
    camera.set_pixel_format_from_string(format).map_err(|problem| {
        let has = camera.dup_available_pixel_formats_as_strings().unwrap_or_default().join(", ");
        anyhow::anyhow!(
            "the camera gives no `{format}` ({problem}); it has {has}. set `source.bayer` to the colours of its pixels"
        )
    })
}

/// Sets the size of the frames, from the middle of the sensor.
fn set_region(camera: &Camera, size: FrameSize) -> anyhow::Result<()> {
    // Otherwise there is less room. A camera may have no offsets.
    for offset in ["OffsetX", "OffsetY"] {
        let _ = camera.set_integer(offset, 0);
    }
    let (_, max_width) = camera.width_bounds().context("asking for the largest width")?;
    let (_, max_height) = camera.height_bounds().context("asking for the largest height")?;
    let [width, height] = [size.width, size.height].map(|edge| edge as i32);
    ensure!(
        width <= max_width && height <= max_height,
        "`source.size_px` is [{width}, {height}], and the camera gives at most [{max_width}, {max_height}] now; binning makes \
         it smaller"
    );
    let middle = |max: i32, edge: i32, step: i32| (max - edge) / 2 / step.max(1) * step.max(1);
    let x = middle(max_width, width, camera.x_offset_increment().unwrap_or(1));
    let y = middle(max_height, height, camera.y_offset_increment().unwrap_or(1));
    camera.set_region(x, y, width, height).context("setting `source.size_px`")?;
    let (_, _, set_width, set_height) = camera.region().context("asking for the frames' size")?;
    if (set_width, set_height) != (width, height) {
        bail!(
            "`source.size_px` is [{width}, {height}]; the nearest that the camera gives is [{set_width}, {set_height}]"
        );
    }
    Ok(())
}
