//! Defines the errors of scenes and frames that cannot be drawn.

/// Why a frame cannot be rendered.
#[derive(Copy, Clone, Debug, PartialEq)]
pub enum RenderError {
    /// No pose was given.
    NoPose,
    /// A pose that is not finite, has an invalid rotation, or is more than 100 km away.
    Pose {
        /// Its index among the poses.
        index: usize,
    },
    /// A buffer whose size is not that of the image.
    Size {
        /// Bytes of the buffer.
        len: usize,
        /// Bytes of the image.
        needed: usize,
    },
    /// An invalid setting of the camera or the scene.
    Setting(&'static str),
}

impl std::fmt::Display for RenderError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::NoPose => write!(f, "no pose of the camera is given"),
            Self::Pose { index } => {
                write!(
                    f,
                    "pose {index} is not finite, has an invalid rotation, or is more than 100 km away"
                )
            }
            Self::Size { len, needed } => {
                write!(f, "the buffer has {len} bytes, the image {needed}")
            }
            Self::Setting(problem) => write!(f, "{problem}"),
        }
    }
}

impl std::error::Error for RenderError {}
