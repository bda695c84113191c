//! Defines the input, the result and the limits of a photometric fit.

use geometry::CameraModel;
use imaging::GrayView;
use nalgebra::SMatrix;

use crate::families::rings::circle_pose::CirclePose;
use crate::optics::camera_response::CameraResponse;
use crate::optics::mosaic::Mosaic;
use crate::response::ResponseEstimate;

/// Grey values above this are saturated: the light may be of any brightness.
pub(super) const MAX_GREY: f64 = 254.5;
/// A root mean square residual above this, in units of the contrast, is not a marker's.
pub(super) const MAX_RESIDUAL: f64 = 0.2;
/// Maximum fraction of a plain disc's squared residuals that a marker's rings leave.
pub(super) const MAX_DISC_RATIO: f64 = 0.12;
/// Pose (5), blur, black, white, and the gradient of white to the right and down.
pub(super) const UNKNOWNS: usize = 10;
/// The same and two numbers of the motion or of the camera's response.
pub(super) const UNKNOWNS_WITH_EXTRAS: usize = 12;

/// The unknowns besides pose, blur and light.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub(super) enum Extras {
    Nothing,
    Motion,
    Response,
}

/// When a fit ends.
#[derive(Copy, Clone, Debug)]
pub(super) struct Effort {
    /// The first steps may hardly improve anything.
    pub(super) min_steps: usize,
    pub(super) max_steps: usize,
    /// Steps of a fit that starts from another one.
    pub(super) max_steps_from_other: usize,
    /// After this many steps the Huber limit follows the residuals.
    pub(super) rough_steps: Option<usize>,
    /// A step that lowers the cost by a smaller fraction is the last one.
    pub(super) min_gain: f64,
}

impl Effort {
    pub(super) const FULL: Self = Self {
        min_steps: 3,
        max_steps: 22,
        max_steps_from_other: 10,
        rough_steps: Some(3),
        min_gain: 3e-4,
    };
    /// For a tracked marker near its predicted pose.
    pub(super) const TRACKED: Self = Self {
        min_steps: 1,
        max_steps: 6,
        max_steps_from_other: 1,
        rough_steps: None,
        min_gain: 3e-2,
    };
}

/// A marker's model fitted to an image.
#[derive(Copy, Clone, Debug)]
pub(crate) struct PhotometricFit {
    pub(crate) pose: CirclePose,
    /// Covariance of the centre (m) and of the normal along [`CirclePose::basis`] (rad).
    pub(crate) covariance: SMatrix<f64, 5, 5>,
    /// Root mean square residual, in units of the contrast.
    pub(crate) residual: f64,
    /// The fraction of the variance inside the marker that the model explains.
    pub(crate) r_squared: f64,
    /// Squared residuals of free rings over those of a plain disc.
    pub(crate) disc_ratio: f64,
    /// Darkness of the middle ring in units of the outer one, each fitted on its own.
    pub(crate) ring_balance: f64,
    /// White minus black, in grey levels.
    pub(crate) contrast: f64,
    /// The grey level of black.
    pub(crate) black: f64,
    /// Standard deviation of the blur, in pixels.
    pub(crate) blur_px: f64,
    pub(crate) response: CameraResponse,
    /// The same with its deviations, where it was fitted.
    pub(crate) estimated_response: Option<ResponseEstimate>,
    /// The mosaic from which the pixels were interpolated.
    pub(crate) mosaic: Option<Mosaic>,
    /// Of a small marker: how far the radii that fit best are from its own.
    pub(crate) radii: Option<Radii>,
    /// Of one of up to 26 px that needs no camera's processing: the least cost of a target of evenly wide rings fitted to the same
    /// pixels, over this fit's. A camera's tone curve and compression hide the difference.
    pub(crate) target_cost: Option<f64>,
}

impl PhotometricFit {
    /// Whether the rings are there: much closer to the image than a plain disc, with two equally dark rings.
    pub(crate) fn has_rings(&self) -> bool {
        self.disc_ratio < MAX_DISC_RATIO && (0.8..1.25).contains(&self.ring_balance)
    }
}

/// The mirrored pose.
#[derive(Copy, Clone, Debug)]
pub(crate) struct Alternative {
    pub(crate) pose: CirclePose,
    /// As of [`PhotometricFit`].
    pub(crate) residual: f64,
    pub(crate) blur_px: f64,
}

/// The better of the two poses that fit, and the other one where it is distinct.
#[derive(Copy, Clone, Debug)]
pub(crate) struct PhotometricPoses {
    pub(crate) best: PhotometricFit,
    pub(crate) alternative: Option<Alternative>,
}

/// The input of a fit.
#[derive(Copy, Clone)]
pub(crate) struct PhotometricInput<'a> {
    pub(crate) view: GrayView<'a>,
    pub(crate) camera: &'a CameraModel,
    /// The marker's size in metres.
    pub(crate) size_m: f64,
    pub(crate) white_on_black: bool,
}

/// Of a small marker whose pixels were interpolated from a colour mosaic: the image lies below this between the marker (0) and a
/// target of evenly wide rings (1) at two deviations. Of other circles of 10 px and more in 4160 scenes the nearest that passes
/// the other bounds had 0.58.
pub(crate) const MAX_EVENNESS_INTERPOLATED: f64 = 0.4;

/// How far the radii that would fit best are from the marker's: the three circles between the outermost and the dot.
#[derive(Copy, Clone, Debug)]
pub(crate) struct Radii {
    /// The largest difference, as a fraction of the marker's radius.
    pub(crate) off: f64,
    /// The largest standard deviation of a difference.
    pub(crate) deviation: f64,
    /// Where between the marker (0) and a target of evenly wide rings without a dot (1) the image lies, and the standard
    /// deviation of that.
    pub(crate) evenness: f64,
    pub(crate) evenness_deviation: f64,
    /// Whether they are those of smoothed residuals.
    pub(crate) are_smoothed: bool,
}

impl Radii {
    /// Whether evenness is below a bound by two of its standard deviations.
    pub(crate) fn is_below_evenness(&self, max_evenness: f64) -> bool {
        const SIGMAS: f64 = 2.0;
        self.evenness + SIGMAS * self.evenness_deviation < max_evenness
    }
}
