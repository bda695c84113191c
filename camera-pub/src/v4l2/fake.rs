//! Simulates a V4L2 device of uvcvideo for tests, with its own clock, formats, controls, buffers and faults.
//!
//! Its answers are those that users of real cameras recorded: capabilities, and JPEG without bytes per line, of
//! pikvm/ustreamer issue 2 (uvcvideo, PTZ Pro Camera); sizes and intervals, listed twice, of PhotonVision/photonvision
//! issue 1219 (OV9281); exposure in 100 us from 1 to 2500 and its metering 0 to 3 of copyleftdev/facecam-ubuntu. The
//! calls behave as in the kernel's documentation (userspace-api/media/v4l): the nearest size is set, DQBUF answers
//! EAGAIN without a frame and ENODEV without a device, and no buffers are freed that are mapped.

use std::cell::{Cell, RefCell};
use std::collections::VecDeque;
use std::io::{self, Cursor};
use std::rc::Rc;
use std::time::Duration;

use ::image::{GrayImage, ImageFormat, Luma};

use super::abi::{
    BUF_FLAG_ERROR, BUF_FLAG_TIMESTAMP_MONOTONIC, BUF_FLAG_TSTAMP_SRC_SOE, Buffer, CAP_DEVICE_CAPS,
    CID_EXPOSURE_ABSOLUTE, CID_EXPOSURE_AUTO, CTRL_FLAG_NEXT_CTRL, Call, Device, Mapping,
    QueryExtCtrl, TYPE_DISCRETE, fourcc,
};
use super::video::Port;

pub(crate) const MS: i64 = 1_000_000;
const PERIOD_NS: i64 = 10 * MS;
const EXPOSURE_NS: i64 = 5 * MS;
/// The unit of the exposure's control.
const UNIT_NS: i64 = 100_000;
/// Number of frames until a control is in force.
const CONTROL_FRAMES: u32 = 3;
/// Gain of its largest value.
const MAX_GAIN: f64 = 16.0;
/// From the last row's readout to the frame in the buffer.
const DELIVERY_NS: i64 = 4 * MS;
pub(crate) const GAIN: u32 = 0x0098_0913;
const SIZES: [(u32, u32); 3] = [(1280, 720), (640, 480), (320, 240)];

/// The instant of the driver's stamps.
#[derive(Copy, Clone, Debug, PartialEq)]
pub(crate) enum Stamps {
    ExposureStart,
    /// As uvcvideo does: the first packet, when the first row is read.
    FirstPacket,
    FrameEnd,
    /// It does not report its clock.
    Unknown,
}

/// The quirk of a camera.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub(crate) enum Oddity {
    /// Its frames are of two fields.
    Interlaced,
    MultiPlanar,
    /// The bus has no room for it.
    Crowded,
}

/// How a frame was exposed.
#[derive(Copy, Clone, Debug, PartialEq)]
pub(crate) struct Exposed {
    pub(crate) exposure_ns: i64,
    pub(crate) gain: f64,
}

/// The event at a frame.
#[derive(Copy, Clone, Debug, PartialEq)]
pub(crate) enum Happening {
    Damaged,
    Cut,
    /// The driver had no buffer for so many frames.
    Skipped(u32),
    IoError,
    Unplugged(i64),
    /// No more frames until it is opened again.
    Stalled,
    /// Smaller frames until it is opened again.
    Resized,
    /// Stamps of another clock from now on.
    OtherClock,
}

/// A camera.
pub(crate) struct Fake {
    name: &'static str,
    stamps: Stamps,
    readout_ns: i64,
    now_ns: Cell<i64>,
    away_until_ns: Cell<i64>,
    script: RefCell<Vec<(u32, Happening)>>,
    is_metering: Cell<bool>,
    /// The values of its controls.
    exposure: Cell<i32>,
    gain: Cell<i32>,
    /// From which frames on they are in force.
    changes: RefCell<Vec<Change>>,
    /// The level of white at 1 ms and gain 1, of full scale: it shows a pad in its middle; 0 for none.
    light: Cell<f64>,
    is_foreign: Cell<bool>,
    oddity: Cell<Option<Oddity>>,
    /// Where it is plugged in, and whether its path is a link.
    bus: Cell<[u8; 20]>,
    is_linked: Cell<bool>,
    /// The devices at other numbers.
    others: RefCell<Vec<Rc<Self>>>,
    /// The control that it does not set.
    refused: Cell<Option<u32>>,
    /// Whether it sets no gain while it meters.
    chooses_gain: Cell<bool>,
    /// The control whose value it does not return.
    hidden: Cell<Option<u32>>,
    /// How many frames it still gives while it is held, in which no time passes without one; `None` while it is not.
    frames_left: Cell<Option<u32>>,
    open_devices: Cell<u32>,
    mappings: Cell<u32>,
    opened: Cell<u32>,
}

/// A change of its controls.
#[derive(Copy, Clone, Debug)]
struct Change {
    from: u32,
    exposure: i32,
    gain: i32,
}

/// It, opened.
pub(crate) struct FakeDevice {
    fake: Rc<Fake>,
    /// False once it has been unplugged: a device that is plugged in again is another one.
    generation: i64,
    state: RefCell<State>,
}

#[derive(Default)]
struct State {
    bytes: usize,
    memory: Vec<Rc<RefCell<Vec<u8>>>>,
    queued: VecDeque<u32>,
    /// Buffers with frames that have not been given, the oldest first.
    filled: VecDeque<Filled>,
    is_streaming: bool,
    /// The first frame that is in no buffer yet.
    next: u32,
    has_stalled: bool,
    is_resized: bool,
    skipped: u32,
}

/// A buffer and the frame in it.
#[derive(Copy, Clone)]
struct Filled {
    index: u32,
    number: u32,
}

/// One of its buffers.
pub(crate) struct FakeMapping {
    fake: Rc<Fake>,
    bytes: Rc<RefCell<Vec<u8>>>,
}

impl Fake {
    pub(crate) fn of(name: &'static str, stamps: Stamps, readout_ns: i64) -> Rc<Self> {
        Rc::new(Self {
            name,
            stamps,
            readout_ns,
            now_ns: Cell::new(0),
            away_until_ns: Cell::new(0),
            script: RefCell::default(),
            is_metering: Cell::new(false),
            exposure: Cell::new((EXPOSURE_NS / UNIT_NS) as i32),
            gain: Cell::new(0),
            changes: RefCell::default(),
            light: Cell::new(0.0),
            is_foreign: Cell::new(false),
            oddity: Cell::new(None),
            bus: Cell::new(*b"usb-0000:0e:00.0-2.4"),
            is_linked: Cell::new(false),
            others: RefCell::default(),
            refused: Cell::new(None),
            chooses_gain: Cell::new(false),
            hidden: Cell::new(None),
            frames_left: Cell::new(None),
            open_devices: Cell::new(0),
            mappings: Cell::new(0),
            opened: Cell::new(0),
        })
    }

    /// The number of the frame that was exposed then.
    pub(crate) fn number_at(&self, mid_ns: i64) -> u32 {
        ((mid_ns - self.mid_exposure_ns(0)) / PERIOD_NS) as u32
    }

    pub(crate) fn fourcc(&self) -> &'static str {
        self.name
    }

    /// Something will happen at this frame, or the next one that is read.
    pub(crate) fn script(&self, frame: u32, happening: Happening) {
        self.script.borrow_mut().push((frame, happening));
    }

    /// Makes it odd.
    pub(crate) fn make(&self, oddity: Oddity) {
        self.oddity.set(Some(oddity));
    }

    fn is(&self, oddity: Oddity) -> bool {
        self.oddity.get() == Some(oddity)
    }

    /// Lets the camera meter on its own.
    pub(crate) fn meter(&self) {
        self.is_metering.set(true);
    }

    /// Shows a pad in this light.
    pub(crate) fn light(&self, light: f64) {
        self.light.set(light);
    }

    /// Refuses to set this control from now on, or none.
    pub(crate) fn refuse(&self, control: Option<u32>) {
        self.refused.set(control);
    }

    /// Refuses to set its gain while it meters, as UVC allows.
    pub(crate) fn choose_gain(&self) {
        self.chooses_gain.set(true);
    }

    fn refuses(&self, control: u32) -> bool {
        let chooses = control == GAIN && self.chooses_gain.get() && self.is_metering();
        chooses || self.refused.get() == Some(control)
    }

    /// Fails to return the value of this control from now on, or of none.
    pub(crate) fn hide(&self, control: Option<u32>) {
        self.hidden.set(control);
    }

    pub(crate) fn is_metering(&self) -> bool {
        self.is_metering.get()
    }

    /// Exposure time and gain of a frame.
    pub(crate) fn exposed(&self, number: u32) -> Exposed {
        let usual = Change { from: 0, exposure: (EXPOSURE_NS / UNIT_NS) as i32, gain: 0 };
        let changes = self.changes.borrow();
        let change = changes.iter().rev().find(|change| change.from <= number).unwrap_or(&usual);
        Exposed {
            exposure_ns: i64::from(change.exposure) * UNIT_NS,
            gain: 1.0 + f64::from(change.gain) / 255.0 * (MAX_GAIN - 1.0),
        }
    }

    fn control(&self, next: u32, id: u32, value: i32) {
        match id {
            CID_EXPOSURE_AUTO => self.is_metering.set(value != 1),
            CID_EXPOSURE_ABSOLUTE => self.exposure.set(value),
            GAIN => self.gain.set(value),
            _ => {}
        }
        let (exposure, gain) = (self.exposure.get(), self.gain.get());
        self.changes.borrow_mut().push(Change { from: next + CONTROL_FRAMES, exposure, gain });
    }

    /// Gives no frame from now on, and lets no time pass, but for those that are let through.
    pub(crate) fn hold(&self) {
        self.frames_left.set(Some(0));
    }

    /// Lets one more frame through while it is held.
    pub(crate) fn let_through(&self) {
        self.frames_left.set(self.frames_left.get().map(|left| left + 1));
    }

    pub(crate) fn pass(&self, time: Duration) {
        self.now_ns.set(self.now_ns.get() + time.as_nanos() as i64);
    }

    pub(crate) fn plug_in_at(&self, bus: &[u8; 20]) {
        self.bus.set(*bus);
    }

    /// Puts another camera at another number.
    pub(crate) fn add_other(&self, other: &Rc<Self>) {
        self.others.borrow_mut().push(Rc::clone(other));
    }

    /// Gives it a path that is a link.
    pub(crate) fn link(&self) {
        self.is_linked.set(true);
    }

    pub(crate) fn unplug(&self, away_ns: i64) {
        self.away_until_ns.set(self.now_ns.get() + away_ns);
    }

    pub(crate) fn open_devices(&self) -> u32 {
        self.open_devices.get()
    }

    pub(crate) fn mappings(&self) -> u32 {
        self.mappings.get()
    }

    pub(crate) fn opened(&self) -> u32 {
        self.opened.get()
    }

    /// When the middle row of a frame was in the middle of its exposure.
    pub(crate) fn mid_exposure_ns(&self, number: u32) -> i64 {
        self.begins_ns(number) + self.exposed(number).exposure_ns / 2 + self.readout_ns / 2
    }

    /// When the first row of a frame begins to be exposed; not a whole microsecond.
    fn begins_ns(&self, number: u32) -> i64 {
        i64::from(number) * PERIOD_NS + 123
    }

    fn read_ns(&self, number: u32) -> i64 {
        self.begins_ns(number) + self.exposed(number).exposure_ns + self.readout_ns
    }

    /// When a frame is in its buffer.
    fn ready_ns(&self, number: u32) -> i64 {
        self.read_ns(number) + DELIVERY_NS
    }

    fn bytes(&self) -> (u32, usize) {
        match self.name {
            "GREY" => (672, 672 * 480),
            "YUYV" => (1280, 1280 * 480),
            "MJPG" => (0, 640 * 480 * 2),
            _ => (640, 640 * 480 * 3 / 2),
        }
    }
}

impl Port for Rc<Fake> {
    type Device = FakeDevice;

    fn open(&self) -> io::Result<FakeDevice> {
        if self.now_ns.get() < self.away_until_ns.get() {
            return Err(errno(libc::ENOENT));
        }
        self.open_devices.set(self.open_devices.get() + 1);
        self.opened.set(self.opened.get() + 1);
        let generation = self.away_until_ns.get();
        Ok(FakeDevice { fake: Self::clone(self), generation, state: RefCell::default() })
    }

    fn is_by_number(&self) -> bool {
        !self.is_linked.get()
    }

    fn others(&self) -> Vec<Self> {
        self.others.borrow().clone()
    }

    fn name(&self) -> String {
        "/dev/video0".to_owned()
    }

    fn now_ns(&self) -> i64 {
        // Waiting for a frame passes the time; where there is no device, asking for it does.
        if self.open_devices.get() == 0 {
            self.pass(Duration::from_millis(20));
        }
        self.now_ns.get()
    }
}

impl Drop for FakeDevice {
    fn drop(&mut self) {
        self.fake.open_devices.set(self.fake.open_devices.get() - 1);
    }
}

impl Drop for FakeMapping {
    fn drop(&mut self) {
        self.fake.mappings.set(self.fake.mappings.get() - 1);
    }
}

impl Mapping for FakeMapping {
    fn len(&self) -> usize {
        self.bytes.borrow().len()
    }

    fn read<R>(&self, read: impl FnOnce(&[u8]) -> R) -> R {
        read(&self.bytes.borrow())
    }
}

fn errno(code: i32) -> io::Error {
    io::Error::from_raw_os_error(code)
}

impl Device for FakeDevice {
    type Mapping = FakeMapping;

    fn call(&self, call: Call<'_>) -> io::Result<()> {
        if self.is_gone() {
            return Err(errno(libc::ENODEV));
        }
        let mut state = self.state.borrow_mut();
        self.store(&mut state);
        match call {
            Call::QueryCap(capability) => {
                let is_usb = self.fake.stamps == Stamps::FirstPacket;
                let driver = if is_usb { b"uvcvideo" } else { b"unicam\0\0" };
                capability.driver[..8].copy_from_slice(driver);
                capability.card[..14].copy_from_slice(b"PTZ Pro Camera");
                capability.bus_info[..20].copy_from_slice(&self.fake.bus.get());
                capability.capabilities = 0x04a0_0001 | CAP_DEVICE_CAPS;
                let is_multi_planar = self.fake.is(Oddity::MultiPlanar);
                capability.device_caps = if is_multi_planar { 0x0420_1000 } else { 0x0420_0001 };
            }
            Call::EnumFmt(format) if format.index == 0 => {
                format.pixelformat = fourcc(self.fake.name.as_bytes().try_into().unwrap());
                format.description[..11].copy_from_slice(b"Motion-JPEG");
            }
            Call::EnumFrameSizes(size) => {
                let (width, height) = *at(&SIZES, size.index)?;
                (size.kind, size.size[0], size.size[1]) = (TYPE_DISCRETE, width, height);
            }
            Call::EnumFrameIntervals(interval) => {
                let rate = *at(&[120, 60, 30, 120, 60, 30], interval.index)?;
                (interval.kind, interval.interval[0], interval.interval[1]) =
                    (TYPE_DISCRETE, 1, rate);
            }
            Call::SetFormat(format) => {
                if state.is_streaming || !state.memory.is_empty() {
                    return Err(errno(libc::EBUSY));
                }
                let wanted = i64::from(format.pix.width);
                let far = |(width, _): &&(u32, u32)| (i64::from(*width) - wanted).abs();
                let (width, height) = *SIZES.iter().min_by_key(far).unwrap();
                let (stride, bytes) = self.fake.bytes();
                let pixelformat = fourcc(self.fake.name.as_bytes().try_into().unwrap());
                let pix = &mut format.pix;
                (pix.width, pix.height, pix.pixelformat) = (width, height, pixelformat);
                (pix.bytesperline, pix.sizeimage) = (stride, bytes as u32);
                if self.fake.is(Oddity::Interlaced) {
                    pix.field = 4;
                }
                state.bytes = bytes;
            }
            Call::SetParm(parm) => (parm.numerator, parm.denominator) = (1, 100),
            Call::ReqBufs(request) => return self.request(&mut state, &mut request.count),
            Call::QueryBuf(buffer) => {
                let memory = at(&state.memory, buffer.index)?;
                buffer.length = memory.borrow().len() as u32;
                buffer.offset = u64::from(buffer.index) << 16;
            }
            Call::QBuf(buffer) => {
                at(&state.memory, buffer.index)?;
                assert!(!state.queued.contains(&buffer.index), "queued twice");
                state.queued.push_back(buffer.index);
            }
            Call::DqBuf(buffer) => return self.dequeue(&mut state, buffer),
            Call::StreamOn if self.fake.is(Oddity::Crowded) => return Err(errno(libc::ENOSPC)),
            Call::StreamOn => {
                assert!(!state.queued.is_empty(), "no buffers are queued");
                state.is_streaming = true;
                // The first frame that begins now.
                state.next = (self.now_ns() / PERIOD_NS + 1) as u32;
            }
            Call::StreamOff => {
                state.is_streaming = false;
                state.queued.clear();
                state.filled.clear();
            }
            Call::QueryExtCtrl(control) => next_control(control)?,
            Call::GetControl(control) if self.fake.hidden.get() == Some(control.id) => {
                return Err(errno(libc::EIO));
            }
            Call::GetControl(control) if control.id == CID_EXPOSURE_AUTO => {
                control.value = if self.fake.is_metering.get() { 3 } else { 1 };
            }
            Call::GetControl(control) if control.id == CID_EXPOSURE_ABSOLUTE => {
                control.value = self.fake.exposure.get();
            }
            Call::GetControl(control) if control.id == GAIN => control.value = self.fake.gain.get(),
            Call::SetControl(control) if self.fake.refuses(control.id) => {
                return Err(errno(libc::EIO));
            }
            Call::SetControl(control) => self.fake.control(state.next, control.id, control.value),
            _ => return Err(errno(libc::EINVAL)),
        }
        Ok(())
    }

    fn map(&self, buffer: &Buffer) -> io::Result<FakeMapping> {
        let state = self.state.borrow();
        let bytes = Rc::clone(at(&state.memory, (buffer.offset >> 16) as u32)?);
        self.fake.mappings.set(self.fake.mappings.get() + 1);
        Ok(FakeMapping { fake: Rc::clone(&self.fake), bytes })
    }

    fn wait(&self, timeout: Duration) -> io::Result<bool> {
        if self.is_gone() {
            return Ok(true);
        }
        let until_ns = self.now_ns() + timeout.as_nanos() as i64;
        let mut state = self.state.borrow_mut();
        self.store(&mut state);
        let frames_left = self.fake.frames_left.get();
        if frames_left == Some(0) && state.filled.is_empty() {
            return Ok(false);
        }
        let ready_ns = self.fake.ready_ns(state.next);
        if state.filled.is_empty() && state.is_storing() && ready_ns <= until_ns {
            self.fake.now_ns.set(ready_ns);
            self.store(&mut state);
            self.fake.frames_left.set(frames_left.map(|left| left - 1));
        }
        if state.filled.is_empty() {
            self.fake.now_ns.set(until_ns);
        }
        Ok(!state.filled.is_empty())
    }

    fn now_ns(&self) -> i64 {
        self.fake.now_ns.get()
    }
}

impl State {
    /// Whether the next frame will find a buffer.
    fn is_storing(&self) -> bool {
        self.is_streaming && !self.has_stalled && !self.queued.is_empty()
    }
}

impl FakeDevice {
    fn is_gone(&self) -> bool {
        self.generation != self.fake.away_until_ns.get()
    }

    fn request(&self, state: &mut State, count: &mut u32) -> io::Result<()> {
        if self.fake.mappings.get() > 0 || state.is_streaming {
            return Err(errno(libc::EBUSY));
        }
        state.memory = (0..*count).map(|_| Rc::new(RefCell::new(vec![0; state.bytes]))).collect();
        Ok(())
    }

    /// Puts the frames that have come since the last call into buffers; those that find none are lost.
    fn store(&self, state: &mut State) {
        while state.is_streaming
            && !state.has_stalled
            && self.fake.ready_ns(state.next) <= self.now_ns()
        {
            if let Some(index) = state.queued.pop_front() {
                state.filled.push_back(Filled { index, number: state.next });
            }
            state.next += 1;
        }
    }

    fn dequeue(&self, state: &mut State, buffer: &mut Buffer) -> io::Result<()> {
        let oldest = state.filled.front().copied();
        let Filled { index, number } = oldest.ok_or_else(|| errno(libc::EAGAIN))?;
        let happening = {
            let mut script = self.fake.script.borrow_mut();
            let due = script.iter().position(|(at, _)| *at <= number);
            due.map(|due| script.remove(due).1)
        };
        match happening {
            Some(Happening::Stalled) => {
                state.has_stalled = true;
                state.filled.clear();
                return Err(errno(libc::EAGAIN));
            }
            Some(Happening::IoError) => return Err(errno(libc::EIO)),
            Some(Happening::Unplugged(away_ns)) => {
                self.fake.unplug(away_ns);
                return Err(errno(libc::ENODEV));
            }
            Some(Happening::Skipped(frames)) => state.skipped += frames,
            Some(Happening::Resized) => state.is_resized = true,
            Some(Happening::OtherClock) => self.fake.is_foreign.set(true),
            _ => {}
        }
        let number = number + state.skipped;
        state.skipped = 0;
        // A frame that comes while another is read.
        self.fake.now_ns.set(self.now_ns().max(self.fake.ready_ns(number)));
        state.filled.pop_front();
        let bytes = self.fill(state, index, number);
        state.next = state.next.max(number + 1);
        let is_cut = happening == Some(Happening::Cut) || state.is_resized;
        self.describe(buffer, number);
        buffer.index = index;
        buffer.bytesused = (if is_cut { bytes / 4 } else { bytes }) as u32;
        if happening == Some(Happening::Damaged) {
            buffer.flags |= BUF_FLAG_ERROR;
        }
        Ok(())
    }

    /// Writes the frame's number into its first pixels, or as its grey level; returns the frame's bytes.
    fn fill(&self, state: &State, index: u32, number: u32) -> usize {
        let mut memory = state.memory[index as usize].borrow_mut();
        if self.fake.name == "MJPG" {
            let level = Luma([grey_level(number)]);
            let mut jpeg = Cursor::new(Vec::new());
            let picture = GrayImage::from_pixel(640, 480, level);
            picture.write_to(&mut jpeg, ImageFormat::Jpeg).unwrap();
            let jpeg = jpeg.into_inner();
            memory[..jpeg.len()].copy_from_slice(&jpeg);
            return jpeg.len();
        }
        let step = if self.fake.name == "YUYV" { 2 } else { 1 };
        for (at, byte) in number.to_le_bytes().into_iter().enumerate() {
            memory[at * step] = byte;
        }
        if self.fake.light.get() > 0.0 {
            let stride = self.fake.bytes().0 as usize;
            self.paint_pad(number, |x, y| y * stride + x * step, &mut memory);
        }
        state.bytes
    }

    /// Paints a pad of 80 pixels in the middle: stripes of white, and of black of a sixteenth of it.
    fn paint_pad(&self, number: u32, at: impl Fn(usize, usize) -> usize, memory: &mut [u8]) {
        let Exposed { exposure_ns, gain } = self.fake.exposed(number);
        let light = self.fake.light.get() * exposure_ns as f64 / MS as f64 * gain;
        let (black, white) = if self.fake.name == "GREY" { (0.0, 255.0) } else { (16.0, 235.0) };
        let level = |reflectance: f64| {
            (black + (white - black) * (light * reflectance).min(1.0)).round() as u8
        };
        let stripes = [level(1.0), level(1.0 / 16.0)];
        for (x, y) in (280..360).flat_map(|x| (200..280).map(move |y| (x, y))) {
            memory[at(x, y)] = stripes[x / 4 % 2];
        }
    }

    fn describe(&self, buffer: &mut Buffer, number: u32) {
        let (stamp_ns, flags) = match self.fake.stamps {
            Stamps::ExposureStart => (
                self.fake.begins_ns(number),
                BUF_FLAG_TIMESTAMP_MONOTONIC | BUF_FLAG_TSTAMP_SRC_SOE,
            ),
            Stamps::FirstPacket => (
                self.fake.read_ns(number) - self.fake.readout_ns,
                BUF_FLAG_TIMESTAMP_MONOTONIC | BUF_FLAG_TSTAMP_SRC_SOE,
            ),
            Stamps::FrameEnd => (self.fake.read_ns(number), BUF_FLAG_TIMESTAMP_MONOTONIC),
            Stamps::Unknown => (self.fake.begins_ns(number), 0),
        };
        let stamp_ns = stamp_ns + if self.fake.is_foreign.get() { 3_600_000 * MS } else { 0 };
        (buffer.seconds, buffer.microseconds) =
            (stamp_ns / 1_000_000_000, stamp_ns % 1_000_000_000 / 1000);
        (buffer.flags, buffer.sequence) = (flags, number);
    }
}

/// A frame's number after JPEG compression, which changes single pixels.
pub(crate) fn grey_level(number: u32) -> u8 {
    (number % 24) as u8 * 10
}

fn at<T>(entries: &[T], index: u32) -> io::Result<&T> {
    entries.get(index as usize).ok_or_else(|| errno(libc::EINVAL))
}

/// The control after the requested one.
fn next_control(control: &mut QueryExtCtrl) -> io::Result<()> {
    let all = [
        (GAIN, "Gain", 1, 0, 255, 0),
        (CID_EXPOSURE_AUTO, "Auto Exposure", 3, 0, 3, 3),
        (CID_EXPOSURE_ABSOLUTE, "Exposure Time, Absolute", 1, 1, 2500, 156),
    ];
    let last_id = control.id & !CTRL_FLAG_NEXT_CTRL;
    let next = all.into_iter().find(|(id, ..)| *id > last_id);
    let (id, name, kind, minimum, maximum, default_value) =
        next.ok_or_else(|| errno(libc::EINVAL))?;
    *control =
        QueryExtCtrl { id, kind, minimum, maximum, default_value, ..QueryExtCtrl::default() };
    control.name[..name.len()].copy_from_slice(name.as_bytes());
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::v4l2::describe::describe;

    #[test]
    fn a_device_is_described_as_it_answers() {
        let fake = Fake::of("MJPG", Stamps::FirstPacket, 0);
        let description = describe(&fake.open().unwrap()).unwrap();
        assert_eq!((&*description.driver, &*description.card), ("uvcvideo", "PTZ Pro Camera"));
        assert!(description.is_camera && description.formats[0].is_readable);
        assert_eq!(description.formats[0].sizes.len(), 3);
        assert_eq!(description.formats[0].sizes[0].rates_hz, [120.0, 60.0, 30.0]);
        let names: Vec<_> = description.controls.iter().map(|c| c.name.as_str()).collect();
        assert_eq!(names, ["gain", "auto_exposure", "exposure_time_absolute"]);
    }
}
