//! Opens a V4L2 device with a format, size, rate and controls, maps its buffers, and takes frames with the driver's stamps,
//! counting those that were lost.

use std::io;
use std::time::Duration;

use super::abi::{
    BUF_FLAG_ERROR, BUF_FLAG_TIMESTAMP_MASK, BUF_FLAG_TIMESTAMP_MONOTONIC,
    BUF_FLAG_TSTAMP_SRC_MASK, BUF_FLAG_TSTAMP_SRC_SOE, Buffer, CID_EXPOSURE_ABSOLUTE,
    CID_EXPOSURE_AUTO, COLORSPACE_JPEG, Call, Capability, Device, EXPOSURE_MANUAL, ExtControl,
    FIELD_ANY, FIELD_NONE, Format, Mapping, PixFormat, QUANTIZATION_DEFAULT,
    QUANTIZATION_FULL_RANGE, RequestBuffers, StreamParm, text,
};
use super::describe::{
    ControlDescription, control_value, controls, describe, is_camera, is_multi_planar,
};
use super::exposer::{Exposer, ForMarker, Order};
use super::pixels::{Pixels, Rows};
use crate::control::Configured;
use crate::exposure::{Exposure, Shutter, StampedAt};
use crate::marker::{Exposed, Refusal};

/// Number of buffers that the driver fills in turn: one being read, the others for it. Fewer lose frames when the
/// service is late by a period.
const BUFFERS: u32 = 4;
/// Minimum number of buffers that a driver may give instead.
const MIN_BUFFERS: u32 = 2;
/// Maximum number of buffers, if the driver gives more.
const MAX_BUFFERS: u32 = 32;
/// Maximum time from a frame's stamp to its arrival; a longer one is another clock's.
const MAX_DELAY_NS: i64 = 1_000_000_000;
/// Interval at which the exposure time is read again, in case another program sets it: over USB that takes milliseconds.
const EXPOSURE_READ_NS: i64 = 1_000_000_000;
/// Number of frames in a row with an impossible stamp at the start after which the clock is refused, and of frames of
/// another length after which the format has changed.
const IN_A_ROW: u32 = 10;
/// Pause after a refused control before the next is set: over USB a refusal may take the time of many frames.
const EXPOSE_PAUSE_NS: i64 = 1_000_000_000;
/// The driver of USB cameras.
const UVC: &str = "uvcvideo";
/// Change of the exposure time from which on stamps are not exact while it comes into force.
const MAX_UNSURE_NS: u32 = 1_000_000;

/// The format, rate and controls that are requested of a device.
#[derive(Clone, Debug)]
pub(crate) struct Wanted {
    pub(crate) fourcc: String,
    pub(crate) width: u32,
    pub(crate) height: u32,
    pub(crate) rate_hz: f64,
    /// Controls by name, in the order in which they are set.
    pub(crate) controls: Vec<ControlValue>,
    /// For an exposure that follows the marker.
    pub(crate) for_marker: Option<ForMarker>,
    /// The instant of the stamps, where it is configured; else the driver's flags decide.
    pub(crate) stamped_at: Option<StampedAt>,
    pub(crate) readout_ns: i64,
    /// Time from mid-exposure to arrival, for drivers that do not stamp on the host's clock.
    pub(crate) delay_ns: i64,
}

/// A control and the value to set.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct ControlValue {
    pub(crate) name: String,
    pub(crate) value: i32,
}

/// Why there are no frames.
#[derive(Debug, thiserror::Error)]
pub(crate) enum Lost {
    /// The device is gone.
    #[error("it is not connected; `alight cameras` lists those that are")]
    Unplugged,
    /// It gives no frames.
    #[error("it gave no frame for {0:.1?}")]
    Stalled(Duration),
    /// None of its frames could be read.
    #[error("its frames could not be read for {0:.1?}: they are damaged, or no JPEG files")]
    Unreadable(Duration),
    /// Its frames are others than those that were agreed on.
    #[error("its format changed: {0}")]
    FormatChanged(String),
    /// Its stamps are on no clock of this host.
    #[error(
        "its driver stamps frames {before_arrival_s:.3} s before they arrive (0 to 1 s are possible), so that its stamps are \
         not of this machine's clock; for uvcvideo, `modprobe uvcvideo clock=CLOCK_MONOTONIC hwtimestamps=0`"
    )]
    ForeignClock {
        /// Time from the last stamp to the frame's arrival.
        before_arrival_s: f64,
    },
    /// It does not support the configuration.
    #[error("{0}")]
    Refused(String),
    /// It is another camera than the one that is waited for.
    #[error("{0}")]
    Another(String),
    /// It failed in another way.
    #[error("{call}: {cause}")]
    Failed {
        /// The system call.
        call: &'static str,
        /// Its error.
        cause: io::Error,
    },
}

/// The counts of events between frames.
#[derive(Copy, Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct Counts {
    /// Frames that the driver could not store, by the gaps of its numbers.
    pub(crate) missed: u64,
    /// Frames that waited in the driver's buffers until a newer one was there.
    pub(crate) queued: u64,
    /// Frames that the driver marked as damaged.
    pub(crate) damaged: u64,
    /// Frames of another length.
    pub(crate) cut: u64,
    /// Frames that arrived sooner after their stamp than they can be read.
    pub(crate) early: u64,
}

/// Which camera a device is.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Identity {
    /// Its name, by which others of its kind are called as well.
    pub(crate) card: String,
    /// Where it is plugged in.
    pub(crate) bus: String,
}

impl Identity {
    /// Of an open device; `None` where it is not a camera.
    pub(crate) fn of(device: &impl Device) -> Option<Self> {
        let mut capability = Capability::default();
        device.call(Call::QueryCap(&mut capability)).ok()?;
        is_camera(&capability).then(|| Self::in_answer(&capability))
    }

    fn in_answer(capability: &Capability) -> Self {
        Self { card: text(&capability.card), bus: text(&capability.bus_info) }
    }
}

/// A device that gives frames.
pub(crate) struct Capture<D: Device> {
    buffers: Vec<D::Mapping>,
    device: D,
    identity: Identity,
    rows: Rows,
    rate_hz: f64,
    stamped_at: Option<StampedAt>,
    /// The instant of stamps that the driver flags as the start of a frame.
    start: StampedAt,
    readout_ns: i64,
    delay_ns: i64,
    /// The number of the last frame by the driver.
    last_sequence: Option<u32>,
    impossible: u32,
    has_clock: bool,
    cut_in_a_row: u32,
    exposure_ns: u32,
    /// Whether it reported, when that was read, that it meters on its own.
    reports_metering: bool,
    /// When `exposure_ns` was read, so long ago at first that it is read.
    exposure_read_ns: i64,
    exposer: Option<Exposer>,
    /// Until when no control is set after a refusal.
    expose_again_ns: i64,
    /// The last order that the device was given, and its answer, where it refused it.
    refusal: Option<Refusal>,
    counts: Counts,
}

/// A frame in the driver's buffer, which gets it back by [`Capture::give_back`].
#[derive(Debug)]
pub(crate) struct Taken {
    index: u32,
    bytes: usize,
    pub(crate) exposure: Exposure,
}

impl<D: Device> Capture<D> {
    /// Opens the device for frames as wanted, and starts them, where it is a camera that is accepted.
    ///
    /// # Errors
    /// It is not a camera or not an accepted one, does not support the configuration, or fails.
    pub(crate) fn start(
        device: D,
        wanted: &Wanted,
        accept: impl FnOnce(&Identity) -> Result<(), Lost>,
    ) -> Result<Self, Lost> {
        let mut capability = Capability::default();
        failed("VIDIOC_QUERYCAP", device.call(Call::QueryCap(&mut capability)))?;
        let identity = Identity::in_answer(&capability);
        // Before anything is set: it may be another service's.
        accept(&identity)?;
        if !is_camera(&capability) {
            let card = text(&capability.card);
            if is_multi_planar(&capability) {
                return Err(Lost::Refused(format!(
                    "`{card}` is multi-planar, which is not read: read it by `source.command` with GStreamer (v4l2src or the \
                     maker's source; docs/camera.md)"
                )));
            }
            return Err(Lost::Refused(format!(
                "`{card}` gives no frames; a camera has several devices, `alight cameras` shows which to take"
            )));
        }
        let rows = set_format(&device, wanted)?;
        let rate_hz = set_rate(&device, wanted.rate_hz)?;
        set_controls(&device, &wanted.controls)?;
        let exposer = wanted.for_marker.as_ref().map(|wanted| {
            let known = failed("VIDIOC_QUERY_EXT_CTRL", controls(&device))?;
            Exposer::of(&known, wanted).map_err(Lost::Refused)
        });
        let mut capture = Self {
            buffers: Vec::new(),
            device,
            identity,
            rows,
            rate_hz,
            stamped_at: wanted.stamped_at,
            // uvcvideo stamps the first packet of a frame, which a camera sends once it reads its first row, or later.
            start: match text(&capability.driver).as_str() {
                UVC => StampedAt::ReadoutStart,
                _ => StampedAt::ExposureStart,
            },
            readout_ns: wanted.readout_ns,
            delay_ns: wanted.delay_ns,
            last_sequence: None,
            impossible: 0,
            has_clock: false,
            cut_in_a_row: 0,
            exposure_ns: 0,
            reports_metering: false,
            exposure_read_ns: i64::MIN,
            exposer: exposer.transpose()?,
            expose_again_ns: i64::MIN,
            refusal: None,
            counts: Counts::default(),
        };
        // From here on `drop` releases the buffers.
        capture.request_buffers()?;
        match capture.device.call(Call::StreamOn) {
            Err(cause) if cause.raw_os_error() == Some(libc::ENOSPC) => {
                return Err(Lost::Refused(format!(
                    "its USB bus has no room left for it (VIDIOC_STREAMON: {cause}): set a lower rate or a smaller size, `MJPG`, or \
                     plug it in at another bus"
                )));
            }
            started => failed("VIDIOC_STREAMON", started)?,
        }
        Ok(capture)
    }

    /// Which camera it is.
    pub(crate) fn identity(&self) -> &Identity {
        &self.identity
    }

    /// The rate at which the device gives frames.
    pub(crate) fn rate_hz(&self) -> f64 {
        self.rate_hz
    }

    /// True once a stamp was of the host's clock.
    pub(crate) fn has_clock(&self) -> bool {
        self.has_clock
    }

    /// Its stamps have been of the host's clock before it was opened: where they are not, frames are stamped by their arrival.
    pub(crate) fn believe_clock(&mut self) {
        self.has_clock = true;
    }

    /// How the newest frame was exposed; `None` where the exposure does not follow the marker.
    pub(crate) fn exposed(&self) -> Option<Exposed> {
        let exposer = self.exposer.as_ref()?;
        Some(Exposed {
            has_metering: exposer.has_metering(),
            is_metering: exposer.is_metering(),
            ordered: exposer.ordered(),
            setting: exposer.setting(),
            limits: exposer.limits(),
            is_limited: self.rows.is_limited,
        })
    }

    /// Sets the exposure of later frames; after a refusal not for a second.
    ///
    /// # Errors
    /// The device is gone, or refuses, and then gives frames all the same.
    pub(crate) fn expose(&mut self, order: Order) -> Result<(), Lost> {
        let now_ns = self.device.now_ns();
        let Some(exposer) = self.exposer.as_mut().filter(|_| now_ns >= self.expose_again_ns) else {
            return Ok(());
        };
        let set = failed("VIDIOC_S_EXT_CTRLS", exposer.follow(&self.device, order));
        self.refusal = set.as_ref().err().map(|lost| Refusal { order, answer: lost.to_string() });
        if set.is_err() {
            self.expose_again_ns = now_ns.saturating_add(EXPOSE_PAUSE_NS);
            // A part of it may have been set.
            self.exposure_read_ns = i64::MIN;
        }
        if let Some(exposure_ns) = set? {
            (self.exposure_ns, self.exposure_read_ns) = (exposure_ns, now_ns);
        }
        Ok(())
    }

    /// The last order that the device was given, where it refused it, until it takes one.
    pub(crate) fn refusal(&self) -> Option<&Refusal> {
        self.refusal.as_ref()
    }

    /// How the device is exposed where the exposure does not follow the marker; `None` as long as it does not report that.
    pub(crate) fn configured(&self) -> Option<Configured> {
        match self.exposure_ns {
            0 => self.reports_metering.then_some(Configured::Metering),
            exposure_ns => Some(Configured::Fixed { exposure_ns }),
        }
    }

    /// The counts since the last call.
    pub(crate) fn take_counts(&mut self) -> Counts {
        std::mem::take(&mut self.counts)
    }

    fn request_buffers(&mut self) -> Result<(), Lost> {
        let mut request = RequestBuffers::of(BUFFERS);
        failed("VIDIOC_REQBUFS", self.device.call(Call::ReqBufs(&mut request)))?;
        if !(MIN_BUFFERS..=MAX_BUFFERS).contains(&request.count) {
            let count = request.count;
            return Err(Lost::Refused(format!(
                "its driver gives {count} buffers, from {MIN_BUFFERS} to {MAX_BUFFERS} are needed; is there memory left?"
            )));
        }
        for index in 0..request.count {
            let mut buffer = Buffer::of(index);
            failed("VIDIOC_QUERYBUF", self.device.call(Call::QueryBuf(&mut buffer)))?;
            self.buffers.push(failed("mmap", self.device.map(&buffer))?);
            failed("VIDIOC_QBUF", self.device.call(Call::QBuf(&mut Buffer::of(index))))?;
        }
        Ok(())
    }

    /// Takes the newest complete frame; `None` when there is none within `timeout`, or only damaged ones.
    ///
    /// # Errors
    /// The device is gone, or its frames differ from the negotiated format.
    pub(crate) fn take(&mut self, timeout: Duration) -> Result<Option<Taken>, Lost> {
        let mut newest: Option<Buffer> = None;
        // A reader that needs more than a period for a frame would otherwise get the oldest, after all buffers have filled.
        for taken in 0..self.buffers.len() {
            let timeout = if taken == 0 { timeout } else { Duration::ZERO };
            let Some(buffer) = self.dequeue(timeout)? else { break };
            let refused = if self.is_complete(&buffer)? {
                let older = newest.replace(buffer);
                self.counts.queued += u64::from(older.is_some());
                older
            } else {
                Some(buffer)
            };
            if let Some(refused) = refused {
                self.queue(refused.index)?;
            }
        }
        let Some(buffer) = newest else { return Ok(None) };
        let exposure = self.exposure(&buffer, self.device.now_ns())?;
        Ok(Some(Taken { index: buffer.index, bytes: buffer.bytesused as usize, exposure }))
    }

    /// A buffer that the driver has filled; `None` when there is none within `timeout`.
    fn dequeue(&mut self, timeout: Duration) -> Result<Option<Buffer>, Lost> {
        if !failed("poll", self.device.wait(timeout))? {
            return Ok(None);
        }
        let mut buffer = Buffer::of(0);
        match self.device.call(Call::DqBuf(&mut buffer)) {
            Ok(()) => {}
            // Nothing there after all, or one frame was lost inside the driver, which continues.
            Err(cause) if matches!(cause.raw_os_error(), Some(libc::EAGAIN | libc::EIO)) => {
                self.counts.damaged += u64::from(cause.raw_os_error() == Some(libc::EIO));
                return Ok(None);
            }
            Err(cause) => return failed("VIDIOC_DQBUF", Err(cause)),
        }
        let read_ns = self.read_ns(&buffer);
        if let Some(exposer) = &mut self.exposer {
            exposer.frame(read_ns);
        }
        if let Some(last) = self.last_sequence.replace(buffer.sequence) {
            self.counts.missed += u64::from(buffer.sequence.wrapping_sub(last).saturating_sub(1));
        }
        Ok(Some(buffer))
    }

    /// Whether a buffer has all of a frame.
    fn is_complete(&mut self, buffer: &Buffer) -> Result<bool, Lost> {
        if buffer.flags & BUF_FLAG_ERROR != 0 {
            self.counts.damaged += 1;
            return Ok(false);
        }
        let mapped = self.buffers.get(buffer.index as usize).map_or(0, Mapping::len);
        let bytes = buffer.bytesused as usize;
        let is_complete = match self.rows.pixels {
            Pixels::Mjpeg => (1..=mapped).contains(&bytes),
            _ => (self.rows.min_bytes()..=mapped).contains(&bytes),
        };
        if is_complete {
            self.cut_in_a_row = 0;
            return Ok(true);
        }
        self.counts.cut += 1;
        self.cut_in_a_row += 1;
        if self.cut_in_a_row < IN_A_ROW {
            return Ok(false);
        }
        let needed = self.rows.min_bytes();
        Err(Lost::FormatChanged(format!("its frames have {bytes} bytes, {needed} are needed")))
    }

    fn exposure(&mut self, buffer: &Buffer, arrival_ns: i64) -> Result<Exposure, Lost> {
        let by_arrival = Exposure::estimated(arrival_ns - self.delay_ns);
        // Also where the driver's stamps are of no clock of the host: the exposure is published nevertheless.
        if arrival_ns.saturating_sub(self.exposure_read_ns) > EXPOSURE_READ_NS {
            self.read_exposure();
            self.exposure_read_ns = arrival_ns;
        }
        let Some((stamp_ns, shutter)) = self.stamp(buffer) else { return Ok(by_arrival) };
        let unsure_ns = self.exposer.as_ref().map_or(0, Exposer::unsure_ns);
        // Half of the uncertainty is the stamp's error.
        let is_known = unsure_ns < MAX_UNSURE_NS;
        let exposure_ns = if is_known { self.exposure_ns } else { 0 };
        let delay_ns = arrival_ns.saturating_sub(stamp_ns);
        if !(0..=MAX_DELAY_NS).contains(&delay_ns) {
            self.impossible += 1;
            if !self.has_clock && self.impossible == IN_A_ROW {
                return Err(Lost::ForeignClock { before_arrival_s: delay_ns as f64 * 1e-9 });
            }
            return Ok(by_arrival);
        }
        (self.has_clock, self.impossible) = (true, 0);
        if delay_ns < shutter.until_read_ns(0) {
            // A camera that reads a frame into its own memory sends it sooner than it was read: its stamp is of neither.
            self.counts.early += 1;
            return Ok(by_arrival);
        }
        Ok(Exposure { mid_ns: shutter.mid_exposure_ns(stamp_ns, exposure_ns), exposure_ns })
    }

    /// The driver's stamp and its instant; `None` where it is not flagged as of the host's clock.
    fn stamp(&self, buffer: &Buffer) -> Option<(i64, Shutter)> {
        if buffer.flags & BUF_FLAG_TIMESTAMP_MASK != BUF_FLAG_TIMESTAMP_MONOTONIC {
            return None;
        }
        let of_driver = match buffer.flags & BUF_FLAG_TSTAMP_SRC_MASK {
            BUF_FLAG_TSTAMP_SRC_SOE => self.start,
            _ => StampedAt::FrameEnd,
        };
        let stamped_at = self.stamped_at.unwrap_or(of_driver);
        let stamp_ns = buffer
            .seconds
            .saturating_mul(1_000_000_000)
            .saturating_add(buffer.microseconds.saturating_mul(1000));
        Some((stamp_ns, Shutter { stamped_at, readout_ns: self.readout_ns }))
    }

    /// When a frame had been read from the sensor; `None` where its stamp does not give that.
    fn read_ns(&self, buffer: &Buffer) -> Option<i64> {
        let (stamp_ns, shutter) = self.stamp(buffer)?;
        let delay_ns = self.device.now_ns().saturating_sub(stamp_ns);
        let is_possible = (0..=MAX_DELAY_NS).contains(&delay_ns);
        is_possible.then(|| stamp_ns.saturating_add(shutter.until_read_ns(self.exposure_ns)))
    }

    /// Reads the exposure time; 0 while the camera meters on its own, as its choice for a frame is unknown then, and where the
    /// driver does not report whether it meters.
    fn read_exposure(&mut self) {
        let auto = control_value(&self.device, CID_EXPOSURE_AUTO);
        self.reports_metering = matches!(auto, Ok(Some(auto)) if auto != EXPOSURE_MANUAL);
        let is_manual = auto.is_ok() && !self.reports_metering;
        let value = control_value(&self.device, CID_EXPOSURE_ABSOLUTE).ok().flatten();
        let units = value.filter(|_| is_manual).and_then(|value| u32::try_from(value).ok());
        self.exposure_ns = units.and_then(|units| units.checked_mul(100_000)).unwrap_or(0);
    }

    /// Reads the bytes of a frame where the driver wrote them.
    pub(crate) fn read<R>(&self, taken: &Taken, read: impl FnOnce(&[u8]) -> R) -> R {
        match self.buffers.get(taken.index as usize) {
            Some(buffer) => buffer.read(|bytes| read(bytes.get(..taken.bytes).unwrap_or_default())),
            None => read(&[]),
        }
    }

    /// Writes the grey levels of a frame of samples, and returns how many bytes that were.
    pub(crate) fn copy_grey(&self, taken: &Taken, grey: &mut [u8]) -> usize {
        self.read(taken, |bytes| self.rows.copy_grey(bytes, grey))
    }

    /// Gives a frame's buffer back to the driver.
    ///
    /// # Errors
    /// The device is gone.
    #[expect(
        clippy::needless_pass_by_value,
        reason = "a buffer that is given back cannot be read any more"
    )]
    pub(crate) fn give_back(&mut self, taken: Taken) -> Result<(), Lost> {
        self.queue(taken.index)
    }

    fn queue(&self, index: u32) -> Result<(), Lost> {
        failed("VIDIOC_QBUF", self.device.call(Call::QBuf(&mut Buffer::of(index))))
    }
}

impl Lost {
    /// The name under which it is counted.
    pub(crate) fn reason(&self) -> &'static str {
        match self {
            Self::Unplugged => "camera unplugged",
            Self::Stalled(_) => "camera stalled",
            Self::Unreadable(_) => "camera's frames unreadable",
            Self::FormatChanged(_) => "camera's format changed",
            Self::ForeignClock { .. } => "camera's stamps of another clock",
            Self::Another(_) => "another camera",
            Self::Refused(_) => "camera refused the configuration",
            Self::Failed { .. } => "camera failed",
        }
    }
}

impl<D: Device> Drop for Capture<D> {
    fn drop(&mut self) {
        // A device keeps its controls beyond this program, which may be started again in another light.
        if let Some(exposer) = &mut self.exposer {
            drop(exposer.follow(&self.device, Order::OwnMetering));
        }
        // A device that was unplugged refuses; its memory is freed when it is closed.
        drop(self.device.call(Call::StreamOff));
        // The driver frees no buffer that is still mapped.
        self.buffers.clear();
        drop(self.device.call(Call::ReqBufs(&mut RequestBuffers::of(0))));
    }
}

/// The error of a call; that of a device that is gone is distinguished.
fn failed<T>(call: &'static str, result: io::Result<T>) -> Result<T, Lost> {
    result.map_err(|cause| match cause.raw_os_error() {
        Some(libc::ENODEV | libc::ENXIO) => Lost::Unplugged,
        Some(libc::EBUSY) => Lost::Refused(format!("another program uses it ({call}: {cause})")),
        _ => Lost::Failed { call, cause },
    })
}

fn set_format(device: &impl Device, wanted: &Wanted) -> Result<Rows, Lost> {
    let Wanted { fourcc, width, height, .. } = wanted;
    let (Some(pixels), Some(pixelformat)) = (Pixels::of(fourcc), Pixels::number(fourcc)) else {
        return Err(Lost::Refused(format!("`{fourcc}` is not a supported pixel format")));
    };
    let pix = PixFormat {
        width: *width,
        height: *height,
        pixelformat,
        field: FIELD_NONE,
        ..PixFormat::default()
    };
    let mut format = Format { pix, ..Format::default() };
    failed("VIDIOC_S_FMT", device.call(Call::SetFormat(&mut format)))?;
    // A driver takes the nearest that it has.
    let pix = format.pix;
    if (pix.pixelformat, pix.width, pix.height) != (pixelformat, *width, *height) {
        let nearest = text(&pix.pixelformat.to_le_bytes());
        let offered = offered(device);
        return Err(Lost::Refused(format!(
            "it has no `{fourcc}` of {width} x {height} pixels, the nearest is `{nearest}` of {} x {}; it has {offered}",
            pix.width, pix.height
        )));
    }
    if ![FIELD_NONE, FIELD_ANY].contains(&pix.field) {
        let field = pix.field;
        return Err(Lost::Refused(format!(
            "its frames are interlaced (field {field} of VIDIOC_S_FMT), which tears moving objects: read it by `source.command` with \
             ffmpeg, deinterlaced (`-vf yadif`)"
        )));
    }
    let [width, height, stride] = [pix.width, pix.height, pix.bytesperline].map(|n| n as usize);
    let is_full = pix.quantization == QUANTIZATION_FULL_RANGE
        || (pix.quantization == QUANTIZATION_DEFAULT && pix.colorspace == COLORSPACE_JPEG);
    // Grey cameras and JPEG files have no other.
    let is_limited = matches!(pixels, Pixels::Yuyv | Pixels::LumaFirst) && !is_full;
    let rows = Rows { pixels, width, height, stride, is_limited };
    // Drivers leave it at 0 for JPEG, and some for samples without padding.
    let stride = if stride == 0 { rows.row_bytes() } else { stride };
    if pixels != Pixels::Mjpeg && stride < rows.row_bytes() {
        let needed = rows.row_bytes();
        return Err(Lost::Refused(format!("its rows have {stride} bytes, {needed} are needed")));
    }
    Ok(Rows { stride, ..rows })
}

/// The formats and sizes that a device has and that are read, as text.
fn offered(device: &impl Device) -> String {
    let formats = describe(device).map(|description| description.formats).unwrap_or_default();
    let readable = formats.iter().filter(|format| format.is_readable);
    let texts = readable.map(|format| {
        let sizes = format.sizes.iter().map(|size| format!("{} x {}", size.width, size.height));
        format!("`{}` of {}", format.fourcc, sizes.collect::<Vec<_>>().join(", "))
    });
    let texts: Vec<_> = texts.collect();
    if texts.is_empty() { "no format that is read".to_owned() } else { texts.join("; ") }
}

/// Sets the frame rate; returns that which the device has taken.
fn set_rate(device: &impl Device, rate_hz: f64) -> Result<f64, Lost> {
    let (numerator, denominator) = (1000, (rate_hz * 1000.0).round() as u32);
    let mut parm = StreamParm { numerator, denominator, ..StreamParm::default() };
    match device.call(Call::SetParm(&mut parm)) {
        Ok(()) if parm.numerator > 0 && parm.denominator > 0 => {
            Ok(f64::from(parm.denominator) / f64::from(parm.numerator))
        }
        // A driver of a single rate has no such call.
        Ok(()) => Ok(rate_hz),
        Err(cause) if matches!(cause.raw_os_error(), Some(libc::EINVAL | libc::ENOTTY)) => {
            Ok(rate_hz)
        }
        Err(cause) => failed("VIDIOC_S_PARM", Err(cause)),
    }
}

fn set_controls(device: &impl Device, values: &[ControlValue]) -> Result<(), Lost> {
    if values.is_empty() {
        return Ok(());
    }
    let known = failed("VIDIOC_QUERY_EXT_CTRL", controls(device))?;
    for ControlValue { name, value } in values {
        let Some(control) = known.iter().find(|control| control.name == *name) else {
            let names: Vec<_> = known.iter().map(|control| control.name.as_str()).collect();
            return Err(Lost::Refused(format!(
                "it has no control `{name}` of `source.controls`; it has {}",
                names.join(", ")
            )));
        };
        let ControlDescription { id, min, max, is_writable, .. } = *control;
        if !(min..=max).contains(&i64::from(*value)) || !is_writable {
            let may = if is_writable { format!("from {min} to {max}") } else { "only read".into() };
            return Err(Lost::Refused(format!(
                "`source.controls` sets `{name}` to {value}, but it can be {may}"
            )));
        }
        let mut set = ExtControl { id, value: *value, ..ExtControl::default() };
        failed("VIDIOC_S_EXT_CTRLS", device.call(Call::SetControl(&mut set)))?;
    }
    Ok(())
}
