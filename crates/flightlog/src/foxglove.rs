//! Foxglove's well-known types, which its panels show without any set-up: pictures, the detections in them,
//! calibrations, coordinate frames, poses, positions on a map and a log.
//!
//! Names and field numbers are those of Foxglove's schemas; `tests/recording/read.py` compares them with its package
//! `foxglove-schemas-protobuf`.

use crate::protobuf::{Encoder, EnumType, Field, Kind, MessageType, Value, bytes_of};

const fn one(name: &'static str, number: u32, kind: Kind) -> Field {
    Field { name, number, kind, is_repeated: false }
}

const fn many(name: &'static str, number: u32, kind: Kind) -> Field {
    Field { name, number, kind, is_repeated: true }
}

const fn value(name: &'static str, number: u64) -> Value {
    Value { name, number }
}

static TIMESTAMP: MessageType = MessageType {
    name: "google.protobuf.Timestamp",
    fields: &[one("seconds", 1, Kind::Int64), one("nanos", 2, Kind::Int32)],
    enums: &[],
};

static POINT2: MessageType = MessageType {
    name: "foxglove.Point2",
    fields: &[one("x", 1, Kind::Double), one("y", 2, Kind::Double)],
    enums: &[],
};

static COLOR: MessageType = MessageType {
    name: "foxglove.Color",
    fields: &[
        one("r", 1, Kind::Double),
        one("g", 2, Kind::Double),
        one("b", 3, Kind::Double),
        one("a", 4, Kind::Double),
    ],
    enums: &[],
};

static VECTOR3: MessageType = MessageType {
    name: "foxglove.Vector3",
    fields: &[one("x", 1, Kind::Double), one("y", 2, Kind::Double), one("z", 3, Kind::Double)],
    enums: &[],
};

static QUATERNION: MessageType = MessageType {
    name: "foxglove.Quaternion",
    fields: &[
        one("x", 1, Kind::Double),
        one("y", 2, Kind::Double),
        one("z", 3, Kind::Double),
        one("w", 4, Kind::Double),
    ],
    enums: &[],
};

/// A picture as a JPEG file.
pub static COMPRESSED_IMAGE: MessageType = MessageType {
    name: "foxglove.CompressedImage",
    fields: &[
        one("timestamp", 1, Kind::Message(&TIMESTAMP)),
        one("data", 2, Kind::Bytes),
        one("format", 3, Kind::Text),
        one("frame_id", 4, Kind::Text),
    ],
    enums: &[],
};

/// A picture, pixel by pixel.
pub static RAW_IMAGE: MessageType = MessageType {
    name: "foxglove.RawImage",
    fields: &[
        one("timestamp", 1, Kind::Message(&TIMESTAMP)),
        one("width", 2, Kind::Fixed32),
        one("height", 3, Kind::Fixed32),
        one("encoding", 4, Kind::Text),
        one("step", 5, Kind::Fixed32),
        one("data", 6, Kind::Bytes),
        one("frame_id", 7, Kind::Text),
    ],
    enums: &[],
};

/// The contents of a camera's picture.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub enum Image<'a> {
    /// A file, of [`COMPRESSED_IMAGE`].
    File(&'a [u8]),
    /// Its pixels, of [`RAW_IMAGE`].
    Pixels(&'a [u8]),
}

/// The contents of a message of [`COMPRESSED_IMAGE`] or [`RAW_IMAGE`]; `None` for another.
pub fn image(message: &[u8]) -> Option<Image<'_>> {
    // The second field of pixels is their width, which is a number, not bytes.
    let file = bytes_of(message, 2).map(Image::File);
    file.or_else(|| bytes_of(message, 6).map(Image::Pixels))
}

static POINTS_TYPE: EnumType = EnumType {
    name: "Type",
    values: &[
        value("UNKNOWN", 0),
        value("POINTS", 1),
        value("LINE_LOOP", 2),
        value("LINE_STRIP", 3),
        value("LINE_LIST", 4),
    ],
};

static POINTS: MessageType = MessageType {
    name: "foxglove.PointsAnnotation",
    fields: &[
        one("timestamp", 1, Kind::Message(&TIMESTAMP)),
        one("type", 2, Kind::Enum(&POINTS_TYPE)),
        many("points", 3, Kind::Message(&POINT2)),
        one("outline_color", 4, Kind::Message(&COLOR)),
        many("outline_colors", 5, Kind::Message(&COLOR)),
        one("fill_color", 6, Kind::Message(&COLOR)),
        one("thickness", 7, Kind::Double),
    ],
    enums: &[&POINTS_TYPE],
};

static CIRCLE: MessageType = MessageType {
    name: "foxglove.CircleAnnotation",
    fields: &[
        one("timestamp", 1, Kind::Message(&TIMESTAMP)),
        one("position", 2, Kind::Message(&POINT2)),
        one("diameter", 3, Kind::Double),
        one("thickness", 4, Kind::Double),
        one("fill_color", 5, Kind::Message(&COLOR)),
        one("outline_color", 6, Kind::Message(&COLOR)),
    ],
    enums: &[],
};

static TEXT: MessageType = MessageType {
    name: "foxglove.TextAnnotation",
    fields: &[
        one("timestamp", 1, Kind::Message(&TIMESTAMP)),
        one("position", 2, Kind::Message(&POINT2)),
        one("text", 3, Kind::Text),
        one("font_size", 4, Kind::Double),
        one("text_color", 5, Kind::Message(&COLOR)),
        one("background_color", 6, Kind::Message(&COLOR)),
    ],
    enums: &[],
};

/// Drawings over a picture of the same time.
pub static IMAGE_ANNOTATIONS: MessageType = MessageType {
    name: "foxglove.ImageAnnotations",
    fields: &[
        many("circles", 1, Kind::Message(&CIRCLE)),
        many("points", 2, Kind::Message(&POINTS)),
        many("texts", 3, Kind::Message(&TEXT)),
    ],
    enums: &[],
};

/// A camera's calibration.
pub static CAMERA_CALIBRATION: MessageType = MessageType {
    name: "foxglove.CameraCalibration",
    fields: &[
        one("timestamp", 1, Kind::Message(&TIMESTAMP)),
        one("width", 2, Kind::Fixed32),
        one("height", 3, Kind::Fixed32),
        one("distortion_model", 4, Kind::Text),
        many("D", 5, Kind::Double),
        many("K", 6, Kind::Double),
        many("R", 7, Kind::Double),
        many("P", 8, Kind::Double),
        one("frame_id", 9, Kind::Text),
    ],
    enums: &[],
};

static FRAME_TRANSFORM: MessageType = MessageType {
    name: "foxglove.FrameTransform",
    fields: &[
        one("timestamp", 1, Kind::Message(&TIMESTAMP)),
        one("parent_frame_id", 2, Kind::Text),
        one("child_frame_id", 3, Kind::Text),
        one("translation", 4, Kind::Message(&VECTOR3)),
        one("rotation", 5, Kind::Message(&QUATERNION)),
    ],
    enums: &[],
};

/// Coordinate frames in each other.
pub static FRAME_TRANSFORMS: MessageType = MessageType {
    name: "foxglove.FrameTransforms",
    fields: &[many("transforms", 1, Kind::Message(&FRAME_TRANSFORM))],
    enums: &[],
};

static POSE: MessageType = MessageType {
    name: "foxglove.Pose",
    fields: &[
        one("position", 1, Kind::Message(&VECTOR3)),
        one("orientation", 2, Kind::Message(&QUATERNION)),
    ],
    enums: &[],
};

/// A pose in a coordinate frame.
pub static POSE_IN_FRAME: MessageType = MessageType {
    name: "foxglove.PoseInFrame",
    fields: &[
        one("timestamp", 1, Kind::Message(&TIMESTAMP)),
        one("frame_id", 2, Kind::Text),
        one("pose", 3, Kind::Message(&POSE)),
    ],
    enums: &[],
};

/// Poses in a coordinate frame.
pub static POSES_IN_FRAME: MessageType = MessageType {
    name: "foxglove.PosesInFrame",
    fields: &[
        one("timestamp", 1, Kind::Message(&TIMESTAMP)),
        one("frame_id", 2, Kind::Text),
        many("poses", 3, Kind::Message(&POSE)),
    ],
    enums: &[],
};

static COVARIANCE_TYPE: EnumType = EnumType {
    name: "PositionCovarianceType",
    values: &[
        value("UNKNOWN", 0),
        value("APPROXIMATED", 1),
        value("DIAGONAL_KNOWN", 2),
        value("KNOWN", 3),
    ],
};

/// A position on the map.
pub static LOCATION_FIX: MessageType = MessageType {
    name: "foxglove.LocationFix",
    fields: &[
        one("latitude", 1, Kind::Double),
        one("longitude", 2, Kind::Double),
        one("altitude", 3, Kind::Double),
        many("position_covariance", 4, Kind::Double),
        one("position_covariance_type", 5, Kind::Enum(&COVARIANCE_TYPE)),
        one("timestamp", 6, Kind::Message(&TIMESTAMP)),
        one("frame_id", 7, Kind::Text),
    ],
    enums: &[&COVARIANCE_TYPE],
};

static LEVEL: EnumType = EnumType {
    name: "Level",
    values: &[
        value("UNKNOWN", 0),
        value("DEBUG", 1),
        value("INFO", 2),
        value("WARNING", 3),
        value("ERROR", 4),
        value("FATAL", 5),
    ],
};

/// A line of the log.
pub static LOG: MessageType = MessageType {
    name: "foxglove.Log",
    fields: &[
        one("timestamp", 1, Kind::Message(&TIMESTAMP)),
        one("level", 2, Kind::Enum(&LEVEL)),
        one("message", 3, Kind::Text),
        one("name", 4, Kind::Text),
        one("file", 5, Kind::Text),
        one("line", 6, Kind::Fixed32),
    ],
    enums: &[&LEVEL],
};

/// How grave a line of the log is.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub enum Level {
    /// A normal event.
    Info,
    /// An event that the user should know.
    Warning,
}

/// A rigid transform of a coordinate frame.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct FrameTransform<'a> {
    /// Name of the frame that it is given in.
    pub parent: &'a str,
    /// Name of the frame.
    pub child: &'a str,
    /// Origin of the child in the parent, in metres.
    pub translation_m: [f64; 3],
    /// `parent_from_child` as a unit quaternion w, x, y, z.
    pub rotation_wxyz: [f64; 4],
}

/// A pose.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct Pose {
    /// Its position, in metres.
    pub position_m: [f64; 3],
    /// Its orientation as a unit quaternion w, x, y, z.
    pub orientation_wxyz: [f64; 4],
}

/// A position on the map.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct GeoPosition {
    /// Degrees, north positive.
    pub latitude_deg: f64,
    /// Degrees, east positive.
    pub longitude_deg: f64,
    /// Metres above mean sea level.
    pub altitude_m: f64,
}

/// A picture, pixel by pixel.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct Pixels<'a> {
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// Foxglove's name for the layout of the bytes.
    pub encoding: &'static str,
    /// Bytes of a row.
    pub row_bytes: u32,
    /// The bytes, row by row.
    pub bytes: &'a [u8],
}

/// Colours, from 0 to 1, with opacity.
const GREEN: [f64; 4] = [0.2, 1.0, 0.2, 1.0];
/// As a background of text.
const SHADE: [f64; 4] = [0.0, 0.0, 0.0, 0.5];

fn timestamp(stamp_ns: i64) -> Encoder {
    let (seconds, nanos) = (stamp_ns.div_euclid(1_000_000_000), stamp_ns.rem_euclid(1_000_000_000));
    Encoder::default().varint(1, seconds as u64).varint(2, nanos as u64)
}

fn point(at: [f64; 2]) -> Encoder {
    Encoder::default().double(1, at[0]).double(2, at[1])
}

fn vector(v: [f64; 3]) -> Encoder {
    Encoder::default().double(1, v[0]).double(2, v[1]).double(3, v[2])
}

fn color(rgba: [f64; 4]) -> Encoder {
    let [r, g, b, a] = rgba;
    Encoder::default().double(1, r).double(2, g).double(3, b).double(4, a)
}

fn quaternion([w, x, y, z]: [f64; 4]) -> Encoder {
    Encoder::default().double(1, x).double(2, y).double(3, z).double(4, w)
}

/// A picture as a [`COMPRESSED_IMAGE`].
pub fn compressed_image(stamp_ns: i64, frame_id: &str, jpeg: &[u8]) -> Vec<u8> {
    Encoder::default()
        .message(1, timestamp(stamp_ns))
        .bytes(2, jpeg)
        .text(3, "jpeg")
        .text(4, frame_id)
        .finish()
}

/// A picture as a [`RAW_IMAGE`].
pub fn raw_image(stamp_ns: i64, frame_id: &str, pixels: &Pixels<'_>) -> Vec<u8> {
    Encoder::default()
        .message(1, timestamp(stamp_ns))
        .fixed32(2, pixels.width)
        .fixed32(3, pixels.height)
        .text(4, pixels.encoding)
        .fixed32(5, pixels.row_bytes)
        .bytes(6, pixels.bytes)
        .text(7, frame_id)
        .finish()
}

fn pose(pose: &Pose) -> Encoder {
    Encoder::default()
        .message(1, vector(pose.position_m))
        .message(2, quaternion(pose.orientation_wxyz))
}

/// A pose as a [`POSE_IN_FRAME`], several as [`POSES_IN_FRAME`].
pub fn poses_in_frame(stamp_ns: i64, frame_id: &str, poses: &[Pose]) -> Vec<u8> {
    Encoder::default()
        .message(1, timestamp(stamp_ns))
        .text(2, frame_id)
        .messages(3, poses.iter().map(pose))
        .finish()
}

/// A position as a [`LOCATION_FIX`] whose uncertainty is unknown.
pub fn location_fix(stamp_ns: i64, frame_id: &str, position: GeoPosition) -> Vec<u8> {
    Encoder::default()
        .double(1, position.latitude_deg)
        .double(2, position.longitude_deg)
        .double(3, position.altitude_m)
        .message(6, timestamp(stamp_ns))
        .text(7, frame_id)
        .finish()
}

/// A marker to draw over a picture.
#[derive(Clone, Debug, PartialEq)]
pub struct Outline {
    /// Its centre, in pixels.
    pub centre_px: [f64; 2],
    /// Its corners, in pixels; a circle of `size_px` without.
    pub corners_px: Option<[[f64; 2]; 4]>,
    /// Its extent in the image, in pixels.
    pub size_px: f64,
    /// The text next to it.
    pub text: String,
}

/// Markers as [`IMAGE_ANNOTATIONS`]: an outline, a dot at the centre and a name for each.
pub fn image_annotations(stamp_ns: i64, outlines: &[Outline]) -> Vec<u8> {
    const LINE_LOOP: u64 = 2;
    const DOT_PX: f64 = 3.0;
    const FONT_PX: f64 = 14.0;
    let circle = |centre_px, diameter_px| {
        Encoder::default()
            .message(1, timestamp(stamp_ns))
            .message(2, point(centre_px))
            .double(3, diameter_px)
            .double(4, 1.0)
            .message(6, color(GREEN))
    };
    let dots = outlines.iter().map(|outline| circle(outline.centre_px, DOT_PX));
    let rings = outlines
        .iter()
        .filter(|outline| outline.corners_px.is_none())
        .map(|outline| circle(outline.centre_px, outline.size_px));
    let squares = outlines.iter().filter_map(|outline| {
        let corners = outline.corners_px?;
        let square = Encoder::default().message(1, timestamp(stamp_ns)).varint(2, LINE_LOOP);
        Some(square.messages(3, corners.map(point)).message(4, color(GREEN)).double(7, 1.0))
    });
    let names = outlines.iter().map(|outline| {
        let [x, y] = outline.centre_px;
        Encoder::default()
            .message(1, timestamp(stamp_ns))
            .message(2, point([x + 0.5 * outline.size_px, y]))
            .text(3, &outline.text)
            .double(4, FONT_PX)
            .message(5, color(GREEN))
            .message(6, color(SHADE))
    });
    Encoder::default()
        .messages(1, dots.chain(rings))
        .messages(2, squares)
        .messages(3, names)
        .finish()
}

/// A camera's numbers.
#[derive(Clone, Debug, PartialEq)]
pub struct Calibration<'a> {
    /// Name of the camera's coordinate frame.
    pub frame_id: &'a str,
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// The distortion's name: `plumb_bob`, `rational_polynomial`, `kannala_brandt`; empty without any.
    pub model: &'a str,
    /// The distortion's coefficients.
    pub distortion: &'a [f64],
    /// Focal lengths, in pixels.
    pub focal_px: [f64; 2],
    /// Principal point, in pixels.
    pub centre_px: [f64; 2],
}

/// A calibration as a [`CAMERA_CALIBRATION`].
pub fn camera_calibration(stamp_ns: i64, camera: &Calibration<'_>) -> Vec<u8> {
    let ([fx, fy], [cx, cy]) = (camera.focal_px, camera.centre_px);
    Encoder::default()
        .message(1, timestamp(stamp_ns))
        .fixed32(2, camera.width)
        .fixed32(3, camera.height)
        .text(4, camera.model)
        .doubles(5, camera.distortion)
        .doubles(6, &[fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0])
        .doubles(7, &[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0])
        .doubles(8, &[fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0])
        .text(9, camera.frame_id)
        .finish()
}

/// Coordinate frames as [`FRAME_TRANSFORMS`].
pub fn frame_transforms(stamp_ns: i64, transforms: &[FrameTransform<'_>]) -> Vec<u8> {
    let all = transforms.iter().map(|transform| {
        Encoder::default()
            .message(1, timestamp(stamp_ns))
            .text(2, transform.parent)
            .text(3, transform.child)
            .message(4, vector(transform.translation_m))
            .message(5, quaternion(transform.rotation_wxyz))
    });
    Encoder::default().messages(1, all).finish()
}

/// A line as a [`LOG`].
pub fn log(stamp_ns: i64, level: Level, name: &str, message: &str) -> Vec<u8> {
    let level = match level {
        Level::Info => 2,
        Level::Warning => 3,
    };
    Encoder::default()
        .message(1, timestamp(stamp_ns))
        .varint(2, level)
        .text(3, message)
        .text(4, name)
        .finish()
}
