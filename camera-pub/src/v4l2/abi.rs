//! Defines the kernel's interface: structures, numbers and flags of `linux/videodev2.h`, as they are on 64-bit machines.
//!
//! Names are the kernel's, without `v4l2_`. A test compares sizes, offsets and numbers with the C compiler's.

use std::io;
use std::time::Duration;

/// A single-planar video capture stream, `V4L2_BUF_TYPE_VIDEO_CAPTURE`.
pub(crate) const VIDEO_CAPTURE: u32 = 1;
/// Buffers of the driver that are mapped, `V4L2_MEMORY_MMAP`.
pub(crate) const MEMORY_MMAP: u32 = 1;
/// `V4L2_FIELD_NONE`: whole frames. Drivers that support nothing else may leave `V4L2_FIELD_ANY`.
pub(crate) const FIELD_NONE: u32 = 1;
pub(crate) const FIELD_ANY: u32 = 0;
/// `V4L2_QUANTIZATION_FULL_RANGE`: luma from 0 to 255. The default is that for `V4L2_COLORSPACE_JPEG`, else limited range.
pub(crate) const QUANTIZATION_FULL_RANGE: u32 = 1;
pub(crate) const QUANTIZATION_DEFAULT: u32 = 0;
pub(crate) const COLORSPACE_JPEG: u32 = 7;

pub(crate) const CAP_VIDEO_CAPTURE: u32 = 0x0000_0001;
pub(crate) const CAP_VIDEO_CAPTURE_MPLANE: u32 = 0x0000_1000;
pub(crate) const CAP_STREAMING: u32 = 0x0400_0000;
pub(crate) const CAP_DEVICE_CAPS: u32 = 0x8000_0000;

pub(crate) const BUF_FLAG_ERROR: u32 = 0x0000_0040;
pub(crate) const BUF_FLAG_TIMESTAMP_MASK: u32 = 0x0000_e000;
pub(crate) const BUF_FLAG_TIMESTAMP_MONOTONIC: u32 = 0x0000_2000;
pub(crate) const BUF_FLAG_TSTAMP_SRC_MASK: u32 = 0x0007_0000;
pub(crate) const BUF_FLAG_TSTAMP_SRC_SOE: u32 = 0x0001_0000;

/// `V4L2_FRMSIZE_TYPE_DISCRETE` and `V4L2_FRMIVAL_TYPE_DISCRETE`.
pub(crate) const TYPE_DISCRETE: u32 = 1;

pub(crate) const CTRL_FLAG_DISABLED: u32 = 0x0001;
pub(crate) const CTRL_FLAG_READ_ONLY: u32 = 0x0004;
pub(crate) const CTRL_FLAG_NEXT_CTRL: u32 = 0x8000_0000;
/// Whether the camera meters: `V4L2_EXPOSURE_MANUAL` is 1.
pub(crate) const CID_EXPOSURE_AUTO: u32 = 0x009a_0901;
pub(crate) const EXPOSURE_MANUAL: i32 = 1;
/// The exposure time, in 100 us.
pub(crate) const CID_EXPOSURE_ABSOLUTE: u32 = 0x009a_0902;

#[repr(C)]
#[derive(Clone, Debug, Default)]
pub(crate) struct Capability {
    pub(crate) driver: [u8; 16],
    pub(crate) card: [u8; 32],
    pub(crate) bus_info: [u8; 32],
    pub(crate) version: u32,
    pub(crate) capabilities: u32,
    pub(crate) device_caps: u32,
    pub(crate) reserved: [u32; 3],
}

#[repr(C)]
#[derive(Clone, Debug, Default)]
pub(crate) struct FmtDesc {
    pub(crate) index: u32,
    pub(crate) kind: u32,
    pub(crate) flags: u32,
    pub(crate) description: [u8; 32],
    pub(crate) pixelformat: u32,
    pub(crate) mbus_code: u32,
    pub(crate) reserved: [u32; 3],
}

/// The union of a discrete size (its first two numbers) and a range: minimum, maximum and step of width and height.
#[repr(C)]
#[derive(Clone, Debug, Default)]
pub(crate) struct FrmSizeEnum {
    pub(crate) index: u32,
    pub(crate) pixel_format: u32,
    pub(crate) kind: u32,
    pub(crate) size: [u32; 6],
    pub(crate) reserved: [u32; 2],
}

/// The union of a discrete interval (numerator and denominator, in seconds) and a range of them: minimum, maximum, step.
#[repr(C)]
#[derive(Clone, Debug, Default)]
pub(crate) struct FrmIvalEnum {
    pub(crate) index: u32,
    pub(crate) pixel_format: u32,
    pub(crate) width: u32,
    pub(crate) height: u32,
    pub(crate) kind: u32,
    pub(crate) interval: [u32; 6],
    pub(crate) reserved: [u32; 2],
}

#[repr(C)]
#[derive(Clone, Debug, Default)]
pub(crate) struct PixFormat {
    pub(crate) width: u32,
    pub(crate) height: u32,
    pub(crate) pixelformat: u32,
    pub(crate) field: u32,
    pub(crate) bytesperline: u32,
    pub(crate) sizeimage: u32,
    pub(crate) colorspace: u32,
    pub(crate) private: u32,
    pub(crate) flags: u32,
    pub(crate) encoding: u32,
    pub(crate) quantization: u32,
    pub(crate) xfer_func: u32,
}

/// The union's other members contain pointers, so that it lies at 8.
#[repr(C, align(8))]
#[derive(Clone, Debug)]
pub(crate) struct Format {
    pub(crate) kind: u32,
    pub(crate) padding: u32,
    pub(crate) pix: PixFormat,
    pub(crate) rest: [u8; 152],
}

impl Default for Format {
    fn default() -> Self {
        Self { kind: VIDEO_CAPTURE, padding: 0, pix: PixFormat::default(), rest: [0; 152] }
    }
}

#[repr(C)]
#[derive(Clone, Debug)]
pub(crate) struct StreamParm {
    pub(crate) kind: u32,
    pub(crate) capability: u32,
    pub(crate) capturemode: u32,
    /// The time from frame to frame, in seconds.
    pub(crate) numerator: u32,
    pub(crate) denominator: u32,
    pub(crate) extendedmode: u32,
    pub(crate) readbuffers: u32,
    pub(crate) reserved: [u32; 4],
    pub(crate) rest: [u8; 160],
}

impl Default for StreamParm {
    fn default() -> Self {
        Self {
            kind: VIDEO_CAPTURE,
            capability: 0,
            capturemode: 0,
            numerator: 0,
            denominator: 0,
            extendedmode: 0,
            readbuffers: 0,
            reserved: [0; 4],
            rest: [0; 160],
        }
    }
}

#[repr(C)]
#[derive(Clone, Debug)]
pub(crate) struct RequestBuffers {
    pub(crate) count: u32,
    pub(crate) kind: u32,
    pub(crate) memory: u32,
    pub(crate) capabilities: u32,
    pub(crate) flags: u8,
    pub(crate) reserved: [u8; 3],
}

impl RequestBuffers {
    pub(crate) fn of(count: u32) -> Self {
        let (kind, memory) = (VIDEO_CAPTURE, MEMORY_MMAP);
        Self { count, kind, memory, capabilities: 0, flags: 0, reserved: [0; 3] }
    }
}

#[repr(C)]
#[derive(Clone, Debug, Default)]
pub(crate) struct Buffer {
    pub(crate) index: u32,
    pub(crate) kind: u32,
    pub(crate) bytesused: u32,
    pub(crate) flags: u32,
    pub(crate) field: u32,
    pub(crate) padding: u32,
    pub(crate) seconds: i64,
    pub(crate) microseconds: i64,
    pub(crate) timecode: [u32; 4],
    pub(crate) sequence: u32,
    pub(crate) memory: u32,
    /// Where to map it; the union has room for a pointer.
    pub(crate) offset: u64,
    pub(crate) length: u32,
    pub(crate) reserved2: u32,
    pub(crate) request_fd: i32,
    pub(crate) padding2: u32,
}

impl Buffer {
    pub(crate) fn of(index: u32) -> Self {
        Self { index, kind: VIDEO_CAPTURE, memory: MEMORY_MMAP, ..Self::default() }
    }
}

#[repr(C)]
#[derive(Clone, Debug, Default)]
pub(crate) struct QueryExtCtrl {
    pub(crate) id: u32,
    pub(crate) kind: u32,
    pub(crate) name: [u8; 32],
    pub(crate) minimum: i64,
    pub(crate) maximum: i64,
    pub(crate) step: u64,
    pub(crate) default_value: i64,
    pub(crate) flags: u32,
    pub(crate) elem_size: u32,
    pub(crate) elems: u32,
    pub(crate) nr_of_dims: u32,
    pub(crate) dims: [u32; 4],
    pub(crate) reserved: [u32; 32],
}

/// Packed in the kernel as well: the union of value and pointers lies at 12.
#[repr(C)]
#[derive(Clone, Debug, Default)]
pub(crate) struct ExtControl {
    pub(crate) id: u32,
    pub(crate) size: u32,
    pub(crate) reserved2: u32,
    pub(crate) value: i32,
    pub(crate) value_high: u32,
}

#[repr(C)]
#[derive(Debug)]
pub(crate) struct ExtControls {
    pub(crate) which: u32,
    pub(crate) count: u32,
    pub(crate) error_idx: u32,
    pub(crate) request_fd: i32,
    pub(crate) reserved: u32,
    pub(crate) controls: *mut ExtControl,
}

/// A call to the driver: an ioctl with its argument.
#[derive(Debug)]
pub(crate) enum Call<'a> {
    QueryCap(&'a mut Capability),
    EnumFmt(&'a mut FmtDesc),
    EnumFrameSizes(&'a mut FrmSizeEnum),
    EnumFrameIntervals(&'a mut FrmIvalEnum),
    SetFormat(&'a mut Format),
    SetParm(&'a mut StreamParm),
    ReqBufs(&'a mut RequestBuffers),
    QueryBuf(&'a mut Buffer),
    QBuf(&'a mut Buffer),
    DqBuf(&'a mut Buffer),
    StreamOn,
    StreamOff,
    QueryExtCtrl(&'a mut QueryExtCtrl),
    /// `VIDIOC_G_EXT_CTRLS` of one control.
    GetControl(&'a mut ExtControl),
    /// `VIDIOC_S_EXT_CTRLS` of one control.
    SetControl(&'a mut ExtControl),
}

impl Call<'_> {
    /// The number of the ioctl.
    pub(crate) fn number(&self) -> u32 {
        match self {
            Self::QueryCap(_) => number::<Capability>(READ, 0),
            Self::EnumFmt(_) => number::<FmtDesc>(READ | WRITE, 2),
            Self::SetFormat(_) => number::<Format>(READ | WRITE, 5),
            Self::ReqBufs(_) => number::<RequestBuffers>(READ | WRITE, 8),
            Self::QueryBuf(_) => number::<Buffer>(READ | WRITE, 9),
            Self::QBuf(_) => number::<Buffer>(READ | WRITE, 15),
            Self::DqBuf(_) => number::<Buffer>(READ | WRITE, 17),
            Self::StreamOn => number::<i32>(WRITE, 18),
            Self::StreamOff => number::<i32>(WRITE, 19),
            Self::SetParm(_) => number::<StreamParm>(READ | WRITE, 22),
            Self::GetControl(_) => number::<ExtControls>(READ | WRITE, 71),
            Self::SetControl(_) => number::<ExtControls>(READ | WRITE, 72),
            Self::EnumFrameSizes(_) => number::<FrmSizeEnum>(READ | WRITE, 74),
            Self::EnumFrameIntervals(_) => number::<FrmIvalEnum>(READ | WRITE, 75),
            Self::QueryExtCtrl(_) => number::<QueryExtCtrl>(READ | WRITE, 103),
        }
    }
}

const WRITE: u32 = 1;
const READ: u32 = 2;

/// `_IOC` of the kernel's `asm-generic/ioctl.h`, which x86-64 and arm64 share.
const fn number<T>(direction: u32, nr: u32) -> u32 {
    direction << 30 | (size_of::<T>() as u32) << 16 | (b'V' as u32) << 8 | nr
}

/// A buffer of the driver in this process' memory.
pub(crate) trait Mapping {
    /// Its length in bytes.
    fn len(&self) -> usize;

    /// Reads its bytes, while the buffer is not the driver's.
    fn read<R>(&self, read: impl FnOnce(&[u8]) -> R) -> R;
}

/// An open device: the kernel's, or one that a test plays.
pub(crate) trait Device {
    /// A buffer of the driver in this process' memory.
    type Mapping: Mapping;

    /// Makes an ioctl.
    ///
    /// # Errors
    /// The driver's error, as `errno`.
    fn call(&self, call: Call<'_>) -> io::Result<()>;

    /// Maps the buffer that [`Call::QueryBuf`] described.
    ///
    /// # Errors
    /// The kernel's error.
    fn map(&self, buffer: &Buffer) -> io::Result<Self::Mapping>;

    /// Waits until a buffer can be taken back, or an error is there to be read; false after `timeout`.
    ///
    /// # Errors
    /// The kernel's error.
    fn wait(&self, timeout: Duration) -> io::Result<bool>;

    /// The host's clock, on which drivers stamp.
    fn now_ns(&self) -> i64;
}

/// The four letters of a pixel format as the kernel's number.
pub(crate) const fn fourcc(letters: [u8; 4]) -> u32 {
    u32::from_le_bytes(letters)
}

/// A text in a field of fixed size, which a zero ends where it is shorter.
pub(crate) fn text(bytes: &[u8]) -> String {
    let end = bytes.iter().position(|byte| *byte == 0).unwrap_or(bytes.len());
    String::from_utf8_lossy(bytes.get(..end).unwrap_or_default()).trim().to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fmt::Write as _;
    use std::mem::offset_of;
    use std::process::Command;

    /// A structure's name in C, its size here, and fields with their offsets here.
    struct Layout(&'static str, usize, Vec<(&'static str, usize)>);

    fn layouts() -> Vec<Layout> {
        vec![
            Layout(
                "v4l2_capability",
                size_of::<Capability>(),
                vec![
                    ("card", offset_of!(Capability, card)),
                    ("capabilities", offset_of!(Capability, capabilities)),
                    ("device_caps", offset_of!(Capability, device_caps)),
                ],
            ),
            Layout(
                "v4l2_fmtdesc",
                size_of::<FmtDesc>(),
                vec![
                    ("flags", offset_of!(FmtDesc, flags)),
                    ("description", offset_of!(FmtDesc, description)),
                    ("pixelformat", offset_of!(FmtDesc, pixelformat)),
                ],
            ),
            Layout(
                "v4l2_frmsizeenum",
                size_of::<FrmSizeEnum>(),
                vec![
                    ("type", offset_of!(FrmSizeEnum, kind)),
                    ("discrete.width", offset_of!(FrmSizeEnum, size)),
                    ("stepwise.max_width", offset_of!(FrmSizeEnum, size) + 4),
                    ("stepwise.max_height", offset_of!(FrmSizeEnum, size) + 16),
                ],
            ),
            Layout(
                "v4l2_frmivalenum",
                size_of::<FrmIvalEnum>(),
                vec![
                    ("height", offset_of!(FrmIvalEnum, height)),
                    ("type", offset_of!(FrmIvalEnum, kind)),
                    ("discrete.denominator", offset_of!(FrmIvalEnum, interval) + 4),
                ],
            ),
            Layout(
                "v4l2_format",
                size_of::<Format>(),
                vec![
                    ("fmt.pix.width", offset_of!(Format, pix)),
                    (
                        "fmt.pix.bytesperline",
                        offset_of!(Format, pix) + offset_of!(PixFormat, bytesperline),
                    ),
                    (
                        "fmt.pix.sizeimage",
                        offset_of!(Format, pix) + offset_of!(PixFormat, sizeimage),
                    ),
                    (
                        "fmt.pix.xfer_func",
                        offset_of!(Format, pix) + offset_of!(PixFormat, xfer_func),
                    ),
                ],
            ),
            Layout(
                "v4l2_streamparm",
                size_of::<StreamParm>(),
                vec![
                    ("parm.capture.capability", offset_of!(StreamParm, capability)),
                    ("parm.capture.timeperframe.numerator", offset_of!(StreamParm, numerator)),
                    ("parm.capture.readbuffers", offset_of!(StreamParm, readbuffers)),
                ],
            ),
            Layout(
                "v4l2_requestbuffers",
                size_of::<RequestBuffers>(),
                vec![
                    ("memory", offset_of!(RequestBuffers, memory)),
                    ("flags", offset_of!(RequestBuffers, flags)),
                ],
            ),
            Layout(
                "v4l2_buffer",
                size_of::<Buffer>(),
                vec![
                    ("bytesused", offset_of!(Buffer, bytesused)),
                    ("flags", offset_of!(Buffer, flags)),
                    ("timestamp.tv_sec", offset_of!(Buffer, seconds)),
                    ("timestamp.tv_usec", offset_of!(Buffer, microseconds)),
                    ("timecode", offset_of!(Buffer, timecode)),
                    ("sequence", offset_of!(Buffer, sequence)),
                    ("memory", offset_of!(Buffer, memory)),
                    ("m.offset", offset_of!(Buffer, offset)),
                    ("length", offset_of!(Buffer, length)),
                    ("request_fd", offset_of!(Buffer, request_fd)),
                ],
            ),
            Layout(
                "v4l2_query_ext_ctrl",
                size_of::<QueryExtCtrl>(),
                vec![
                    ("name", offset_of!(QueryExtCtrl, name)),
                    ("minimum", offset_of!(QueryExtCtrl, minimum)),
                    ("step", offset_of!(QueryExtCtrl, step)),
                    ("flags", offset_of!(QueryExtCtrl, flags)),
                    ("dims", offset_of!(QueryExtCtrl, dims)),
                ],
            ),
            Layout(
                "v4l2_ext_control",
                size_of::<ExtControl>(),
                vec![
                    ("size", offset_of!(ExtControl, size)),
                    ("value", offset_of!(ExtControl, value)),
                ],
            ),
            Layout(
                "v4l2_ext_controls",
                size_of::<ExtControls>(),
                vec![
                    ("which", offset_of!(ExtControls, which)),
                    ("error_idx", offset_of!(ExtControls, error_idx)),
                    ("controls", offset_of!(ExtControls, controls)),
                ],
            ),
        ]
    }

    /// Names in C with their numbers here.
    fn numbers() -> Vec<(&'static str, u32)> {
        vec![
            ("VIDIOC_QUERYCAP", Call::QueryCap(&mut Capability::default()).number()),
            ("VIDIOC_ENUM_FMT", Call::EnumFmt(&mut FmtDesc::default()).number()),
            ("VIDIOC_ENUM_FRAMESIZES", Call::EnumFrameSizes(&mut FrmSizeEnum::default()).number()),
            (
                "VIDIOC_ENUM_FRAMEINTERVALS",
                Call::EnumFrameIntervals(&mut FrmIvalEnum::default()).number(),
            ),
            ("VIDIOC_S_FMT", Call::SetFormat(&mut Format::default()).number()),
            ("VIDIOC_S_PARM", Call::SetParm(&mut StreamParm::default()).number()),
            ("VIDIOC_REQBUFS", Call::ReqBufs(&mut RequestBuffers::of(1)).number()),
            ("VIDIOC_QUERYBUF", Call::QueryBuf(&mut Buffer::default()).number()),
            ("VIDIOC_QBUF", Call::QBuf(&mut Buffer::default()).number()),
            ("VIDIOC_DQBUF", Call::DqBuf(&mut Buffer::default()).number()),
            ("VIDIOC_STREAMON", Call::StreamOn.number()),
            ("VIDIOC_STREAMOFF", Call::StreamOff.number()),
            ("VIDIOC_QUERY_EXT_CTRL", Call::QueryExtCtrl(&mut QueryExtCtrl::default()).number()),
            ("VIDIOC_G_EXT_CTRLS", Call::GetControl(&mut ExtControl::default()).number()),
            ("VIDIOC_S_EXT_CTRLS", Call::SetControl(&mut ExtControl::default()).number()),
            ("V4L2_BUF_TYPE_VIDEO_CAPTURE", VIDEO_CAPTURE),
            ("V4L2_MEMORY_MMAP", MEMORY_MMAP),
            ("V4L2_FIELD_NONE", FIELD_NONE),
            ("V4L2_FIELD_ANY", FIELD_ANY),
            ("V4L2_QUANTIZATION_FULL_RANGE", QUANTIZATION_FULL_RANGE),
            ("V4L2_QUANTIZATION_DEFAULT", QUANTIZATION_DEFAULT),
            ("V4L2_COLORSPACE_JPEG", COLORSPACE_JPEG),
            ("V4L2_CAP_VIDEO_CAPTURE", CAP_VIDEO_CAPTURE),
            ("V4L2_CAP_VIDEO_CAPTURE_MPLANE", CAP_VIDEO_CAPTURE_MPLANE),
            ("V4L2_CAP_STREAMING", CAP_STREAMING),
            ("V4L2_CAP_DEVICE_CAPS", CAP_DEVICE_CAPS),
            ("V4L2_BUF_FLAG_ERROR", BUF_FLAG_ERROR),
            ("V4L2_BUF_FLAG_TIMESTAMP_MASK", BUF_FLAG_TIMESTAMP_MASK),
            ("V4L2_BUF_FLAG_TIMESTAMP_MONOTONIC", BUF_FLAG_TIMESTAMP_MONOTONIC),
            ("V4L2_BUF_FLAG_TSTAMP_SRC_MASK", BUF_FLAG_TSTAMP_SRC_MASK),
            ("V4L2_BUF_FLAG_TSTAMP_SRC_SOE", BUF_FLAG_TSTAMP_SRC_SOE),
            ("V4L2_BUF_FLAG_TSTAMP_SRC_EOF", 0),
            ("V4L2_FRMSIZE_TYPE_DISCRETE", TYPE_DISCRETE),
            ("V4L2_FRMIVAL_TYPE_DISCRETE", TYPE_DISCRETE),
            ("V4L2_CTRL_FLAG_DISABLED", CTRL_FLAG_DISABLED),
            ("V4L2_CTRL_FLAG_READ_ONLY", CTRL_FLAG_READ_ONLY),
            ("V4L2_CTRL_FLAG_NEXT_CTRL", CTRL_FLAG_NEXT_CTRL),
            ("V4L2_CID_EXPOSURE_AUTO", CID_EXPOSURE_AUTO),
            ("V4L2_CID_EXPOSURE_ABSOLUTE", CID_EXPOSURE_ABSOLUTE),
            ("V4L2_EXPOSURE_MANUAL", EXPOSURE_MANUAL as u32),
            ("V4L2_CTRL_WHICH_CUR_VAL", 0),
            ("V4L2_PIX_FMT_MJPEG", fourcc(*b"MJPG")),
            ("V4L2_PIX_FMT_GREY", fourcc(*b"GREY")),
            ("V4L2_PIX_FMT_YUYV", fourcc(*b"YUYV")),
            ("V4L2_PIX_FMT_NV12", fourcc(*b"NV12")),
            ("V4L2_PIX_FMT_YUV420", fourcc(*b"YU12")),
        ]
    }

    #[test]
    fn layouts_and_numbers_are_those_of_the_kernels_header() -> io::Result<()> {
        let mut source = "#include <linux/videodev2.h>\n#include <stddef.h>\n#include <stdio.h>\nint main(void) {\n".to_owned();
        let mut expected = String::new();
        for Layout(name, size, fields) in layouts() {
            let _ = writeln!(source, "printf(\"{name} %zu\\n\", sizeof(struct {name}));");
            let _ = writeln!(expected, "{name} {size}");
            for (field, offset) in fields {
                let _ = writeln!(
                    source,
                    "printf(\"{name}.{field} %zu\\n\", offsetof(struct {name}, {field}));"
                );
                let _ = writeln!(expected, "{name}.{field} {offset}");
            }
        }
        for (name, number) in numbers() {
            let _ = writeln!(source, "printf(\"{name} %u\\n\", (unsigned){name});");
            let _ = writeln!(expected, "{name} {number}");
        }
        source.push_str("return 0; }\n");
        let folder = tempfile::tempdir()?;
        let [file, program] = ["layout.c", "layout"].map(|name| folder.path().join(name));
        std::fs::write(&file, source)?;
        let compiled = match Command::new("cc").arg(&file).arg("-o").arg(&program).output() {
            Ok(compiled) => compiled,
            Err(problem) => {
                testing::skip("cc", problem);
                return Ok(());
            }
        };
        let problem = String::from_utf8_lossy(&compiled.stderr);
        if problem.contains("linux/videodev2.h: No such file") {
            testing::skip("linux/videodev2.h", "it is in linux-libc-dev");
            return Ok(());
        }
        assert!(compiled.status.success(), "{problem}");
        let printed = Command::new(&program).output()?.stdout;
        assert_eq!(String::from_utf8_lossy(&printed), expected);
        Ok(())
    }
}
