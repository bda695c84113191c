//! Makes the ioctl, mmap and poll calls to a V4L2 device of the kernel; no other file makes system calls.
#![allow(unsafe_code, reason = "ioctl, mmap and poll have no safe form; nothing else is here")]

use std::fs::{File, OpenOptions};
use std::io;
use std::os::fd::{AsRawFd, RawFd};
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};
use std::ptr::{NonNull, null_mut};
use std::time::Duration;

use super::abi::{Buffer, Call, Device, ExtControl, ExtControls, Mapping, VIDEO_CAPTURE};

use super::video::Port;

/// Where a device of the kernel is.
pub(crate) struct DevicePath(pub(crate) PathBuf);

/// A device of the kernel.
pub(crate) struct KernelDevice {
    file: File,
}

/// A buffer of the driver in this process' memory.
pub(crate) struct KernelMapping {
    start: NonNull<u8>,
    len: usize,
}

impl KernelDevice {
    /// Opens `/dev/video0` and its like.
    ///
    /// # Errors
    /// The kernel's error.
    pub(crate) fn open(path: &Path) -> io::Result<Self> {
        let mut options = OpenOptions::new();
        // A read or DQBUF without a frame must not block: `wait` does, with a bound.
        let file = options.read(true).write(true).custom_flags(libc::O_NONBLOCK).open(path)?;
        Ok(Self { file })
    }
}

impl Port for DevicePath {
    type Device = KernelDevice;

    fn open(&self) -> io::Result<KernelDevice> {
        KernelDevice::open(&self.0)
    }

    fn is_by_number(&self) -> bool {
        let number = self.0.file_name().and_then(|name| name.to_str()?.strip_prefix("video"));
        number.is_some_and(|number| number.bytes().all(|byte| byte.is_ascii_digit()))
    }

    fn others(&self) -> Vec<Self> {
        let entries = self.0.parent().and_then(|folder| std::fs::read_dir(folder).ok());
        let devices = entries.into_iter().flatten().flatten().map(|entry| Self(entry.path()));
        devices.filter(|device| device.is_by_number() && device.0 != self.0).collect()
    }

    fn name(&self) -> String {
        self.0.display().to_string()
    }

    fn now_ns(&self) -> i64 {
        node::now_ns()
    }
}

impl Device for KernelDevice {
    type Mapping = KernelMapping;

    fn call(&self, call: Call<'_>) -> io::Result<()> {
        let (fd, number) = (self.file.as_raw_fd(), call.number());
        match call {
            Call::QueryCap(argument) => ioctl(fd, number, argument),
            Call::EnumFmt(argument) => ioctl(fd, number, argument),
            Call::EnumFrameSizes(argument) => ioctl(fd, number, argument),
            Call::EnumFrameIntervals(argument) => ioctl(fd, number, argument),
            Call::SetFormat(argument) => ioctl(fd, number, argument),
            Call::SetParm(argument) => ioctl(fd, number, argument),
            Call::ReqBufs(argument) => ioctl(fd, number, argument),
            Call::QueryBuf(argument) | Call::QBuf(argument) | Call::DqBuf(argument) => {
                ioctl(fd, number, argument)
            }
            Call::StreamOn | Call::StreamOff => ioctl(fd, number, &mut VIDEO_CAPTURE.cast_signed()),
            Call::QueryExtCtrl(argument) => ioctl(fd, number, argument),
            Call::GetControl(control) | Call::SetControl(control) => {
                ioctl(fd, number, &mut one_control(control))
            }
        }
    }

    fn map(&self, buffer: &Buffer) -> io::Result<KernelMapping> {
        let len = buffer.length as usize;
        let offset = libc::off_t::try_from(buffer.offset)
            .map_err(|_cause| io::Error::from(io::ErrorKind::InvalidInput))?;
        // SAFETY: a new mapping where the kernel likes, of a length and offset that the driver gave for this device; it
        // aliases nothing of this process.
        let start = unsafe {
            libc::mmap(
                null_mut(),
                len,
                libc::PROT_READ,
                libc::MAP_SHARED,
                self.file.as_raw_fd(),
                offset,
            )
        };
        if start == libc::MAP_FAILED {
            return Err(io::Error::last_os_error());
        }
        let start = NonNull::new(start.cast()).ok_or_else(io::Error::last_os_error)?;
        Ok(KernelMapping { start, len })
    }

    fn wait(&self, timeout: Duration) -> io::Result<bool> {
        let mut poll = libc::pollfd { fd: self.file.as_raw_fd(), events: libc::POLLIN, revents: 0 };
        let timeout_ms = i32::try_from(timeout.as_millis()).unwrap_or(i32::MAX);
        // SAFETY: `poll` is one valid entry, and outlives the call.
        match unsafe { libc::poll(&raw mut poll, 1, timeout_ms) } {
            0 => Ok(false),
            // An error condition is read with the next DQBUF.
            1.. => Ok(true),
            _ => match io::Error::last_os_error() {
                cause if cause.kind() == io::ErrorKind::Interrupted => Ok(false),
                cause => Err(cause),
            },
        }
    }

    fn now_ns(&self) -> i64 {
        node::now_ns()
    }
}

fn one_control(control: &mut ExtControl) -> ExtControls {
    let controls = std::ptr::from_mut(control);
    ExtControls { which: 0, count: 1, error_idx: 0, request_fd: 0, reserved: 0, controls }
}

/// Makes an ioctl whose argument is a structure, or a pointer to a number.
fn ioctl<T>(fd: RawFd, number: u32, argument: &mut T) -> io::Result<()> {
    // The number has the argument's size, which the kernel goes by.
    debug_assert_eq!((number >> 16 & 0x3fff) as usize, size_of::<T>());
    loop {
        // SAFETY: `argument` is a valid, exclusive structure of the kernel's layout, which `abi` tests; the kernel reads
        // and writes no more than the size in `number`, and the one pointer in an argument, of `one_control`, is
        // to a control that is borrowed for as long. All bit patterns are valid for its fields.
        let result =
            unsafe { libc::ioctl(fd, number as libc::Ioctl, std::ptr::from_mut(argument)) };
        if result >= 0 {
            return Ok(());
        }
        let cause = io::Error::last_os_error();
        if cause.kind() != io::ErrorKind::Interrupted {
            return Err(cause);
        }
    }
}

impl Mapping for KernelMapping {
    fn len(&self) -> usize {
        self.len
    }

    fn read<R>(&self, read: impl FnOnce(&[u8]) -> R) -> R {
        // SAFETY: the mapping is readable and lives as long as `self`, which the slice does not outlive. `Capture` reads it
        // only between DQBUF and QBUF, while the buffer is not the driver's.
        read(unsafe { std::slice::from_raw_parts(self.start.as_ptr(), self.len) })
    }
}

impl Drop for KernelMapping {
    fn drop(&mut self) {
        // SAFETY: this memory was mapped by `map`, once; no slice of it outlives `self`.
        unsafe { libc::munmap(self.start.as_ptr().cast(), self.len) };
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::v4l2::abi::Capability;

    #[test]
    fn a_device_other_than_a_camera_is_recognised_by_its_answer() {
        let device = KernelDevice::open(Path::new("/dev/null")).unwrap();
        let answer = device.call(Call::QueryCap(&mut Capability::default()));
        assert_eq!(answer.unwrap_err().raw_os_error(), Some(libc::ENOTTY));
        let buffer = Buffer { length: 4096, ..Buffer::of(0) };
        assert!(device.map(&buffer).is_err());
        let missing = KernelDevice::open(Path::new("/dev/video-none")).err().unwrap();
        assert_eq!(missing.kind(), io::ErrorKind::NotFound);
    }

    #[test]
    fn the_devices_of_other_numbers_are_those_in_its_folder() {
        let folder = tempfile::tempdir().unwrap();
        for name in ["video0", "video2", "video10", "v4l-subdev0", "null"] {
            std::fs::write(folder.path().join(name), "").unwrap();
        }
        let others = DevicePath(folder.path().join("video0")).others();
        let mut names: Vec<_> = others.iter().map(|other| other.0.file_name().unwrap()).collect();
        names.sort_unstable();
        assert_eq!(names, ["video10", "video2"]);
    }

    #[test]
    fn a_mapping_shows_the_files_bytes_and_is_given_back() {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), vec![7; 8192]).unwrap();
        let device = KernelDevice::open(file.path()).unwrap();
        for _ in 0..100 {
            let mapping =
                device.map(&Buffer { length: 4096, offset: 4096, ..Buffer::of(0) }).unwrap();
            mapping.read(|bytes| assert_eq!(bytes, [7; 4096]));
        }
        let maps = std::fs::read_to_string("/proc/self/maps").unwrap();
        assert!(!maps.contains(&file.path().display().to_string()), "still mapped");
    }
}
