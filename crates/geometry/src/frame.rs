//! Defines the coordinate frames of the system, as types.

/// A coordinate frame: a type without values that tags points, vectors and transforms.
pub trait Frame: Copy + Clone + std::fmt::Debug + PartialEq + 'static {
    /// The frame's name, for messages to people.
    const NAME: &'static str;
}

macro_rules! frames {
    ($($(#[$doc:meta])* $name:ident = $text:literal;)*) => {$(
        $(#[$doc])*
        #[derive(Copy, Clone, Debug, PartialEq, Eq)]
        pub enum $name {}
        impl Frame for $name {
            const NAME: &'static str = $text;
        }
    )*};
}

frames! {
    /// Origin at the optical centre, x right, y down, z forward along the optical axis.
    Camera = "camera";
    /// Origin at the marker's centre, x right, y up, z out of the printed face.
    Marker = "marker";
    /// Origin at the pad's landing point, x right, y up, z out of the printed face.
    Pad = "pad";
    /// A calibration board: any origin in its plane, x right, y down, z into the paper.
    Board = "board";
    /// The vehicle: x forward, y right, z down (FRD).
    Body = "body";
    /// The world: x north, y east, z down, with the autopilot's local origin.
    Ned = "NED";
    /// The autopilot's local frame without its jumps: axes as NED, an origin that moves with each jump (REP 105 `odom`).
    Odometry = "odometry";
}
