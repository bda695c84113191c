//! Explains why a set of views gives no calibration, in sentences for users.

use crate::lens::Lens;
use crate::view::ImageSize;

/// Why there is no calibration: the value, its limit, and the remedy.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum Refusal {
    /// Not enough views with enough points.
    #[error(
        "{views} {} {min_points} points of the board or more, at least {min_views} must: take more pictures in which \
         the board is whole, sharp and near",
        if *views == 1 { "view shows" } else { "views show" }
    )]
    TooFewViews {
        /// Views that can be used.
        views: usize,
        /// Views that are needed.
        min_views: usize,
        /// Points that a view must show.
        min_points: usize,
    },
    /// More than is solved in a bounded time and memory.
    #[error(
        "{points} points in {views} views are more than the {max_points} that are solved: leave pictures out"
    )]
    TooMany {
        /// Views given.
        views: usize,
        /// Points given.
        points: usize,
        /// Points that are solved.
        max_points: usize,
    },
    /// A coordinate that is not finite, or far outside of the image.
    #[error(
        "a point of {view} is not a position in an image of {size}: the file of points is damaged"
    )]
    InvalidPoint {
        /// The view's name.
        view: String,
        /// The image's size.
        size: ImageSize,
    },
    /// Images of several sizes.
    #[error(
        "{first_view} is {first} and {other_view} is {other}: a calibration is for one mode of the camera, so take all pictures \
         in the mode that is flown"
    )]
    MixedSizes {
        /// A view's name.
        first_view: String,
        /// Its image's size.
        first: ImageSize,
        /// Another view's name.
        other_view: String,
        /// Its image's size.
        other: ImageSize,
    },
    /// The board is seen as in a mirror.
    #[error(
        "{mirrored} of {views} views show the board as in a mirror: switch the camera's mirroring off, or print the board again, \
         not from its back"
    )]
    Mirrored {
        /// Views that are mirrored.
        mirrored: usize,
        /// Views in all.
        views: usize,
    },
    /// Not even roughly a camera and poses that explain the points.
    #[error(
        "no {lens} camera explains the points: they are {noise_px:.1} px off in the median, at most {max_px:.1} px can be \
         mended; check the board's description (size of the tags, their spacing, which tags), and the kind of lens"
    )]
    Diverged {
        /// The lens that was tried.
        lens: Lens,
        /// The points' error.
        noise_px: f64,
        /// Its limit.
        max_px: f64,
    },
    /// Some of the lens's numbers may have any value.
    #[error(
        "the views do not show all {parameters} numbers of {lens}: take more views, tilted and at the image's border, or a \
         model with fewer numbers"
    )]
    Undetermined {
        /// The lens that was tried.
        lens: Lens,
        /// How many numbers it has.
        parameters: usize,
    },
    /// The board always faced the camera.
    #[error(
        "the board was tilted by {tilt_deg:.0} degrees at most (nine views of ten by less), and at least {min_deg:.0} are \
         needed to distinguish focal length from distance: tilt it by 30 to 45 degrees, to all sides"
    )]
    NoTilt {
        /// The tilt that one view of ten exceeds.
        tilt_deg: f64,
        /// Its limit.
        min_deg: f64,
    },
    /// The board was always as far away.
    #[error(
        "the farthest views are {ratio:.2} times as far away as the nearest, at least {min_ratio:.2} times are needed: take some \
         in which the board fills the image, and some from farther away"
    )]
    OneDistance {
        /// Distance of the far views by that of the near ones.
        ratio: f64,
        /// Its limit.
        min_ratio: f64,
    },
    /// Only a part of the image shows the board.
    #[error(
        "the points lie in {covered_percent:.0} % of the image, at least {min_percent:.0} % are needed; nothing was seen \
         {missing}: move the board to there, and to all corners"
    )]
    PartOfImage {
        /// The fraction of the image in which points are.
        covered_percent: f64,
        /// Its limit.
        min_percent: f64,
        /// Where there are fewest.
        missing: &'static str,
    },
    /// The board is not as described: the size of the tags against their spacing.
    #[error(
        "the tags are {} than stated, against their spacing (limit {max_percent:.2} %), which is finer than a ruler shows: measure \
         the side of a tag's black square with a caliper, and the spacing across several tags (from the left edge of the first to \
         that of the last, divided by the steps between them); the gap is the spacing minus the side",
        compared(*percent)
    )]
    TagSize {
        /// How much larger; negative where they are smaller.
        percent: f64,
        /// Its limit.
        max_percent: f64,
    },
    /// The board is not as described: its width against its height, or its angles.
    #[error(
        "the print is distorted by {percent:.2} % (width against height, or out of square; limit {max_percent:.2} %): print at \
         100 % without fitting to the page, and measure both directions"
    )]
    Distorted {
        /// How much.
        percent: f64,
        /// Its limit.
        max_percent: f64,
    },
    /// Within single views the board has another shape than in the others.
    #[error(
        "within single views the points are off together by {structure_px:.2} px (limit {max_px:.2} px): the board or the \
         camera moved while the picture was taken, or the board bends; mount it on something stiff, and hold both still"
    )]
    Moving {
        /// The points' common error within views.
        structure_px: f64,
        /// Its limit.
        max_px: f64,
    },
    /// The lens is of another kind.
    #[error(
        "{lens} does not describe this lens: its residuals depend on the position in the image, by {structure_px:.2} px (limit \
         {max_px:.2} px); take a model with more numbers, or Kannala-Brandt for a wide lens"
    )]
    WrongLens {
        /// The lens that was tried.
        lens: Lens,
        /// The points' common error by place.
        structure_px: f64,
        /// Its limit.
        max_px: f64,
    },
    /// Two halves of the views give cameras that differ by more than they are uncertain.
    #[error(
        "the two halves of the views give cameras that differ by {difference_px:.2} px, {ratio:.1} times their uncertainty \
         (limits {max_px:.2} px and {max_ratio:.1}): the focus or the zoom changed, or the lens is of another kind"
    )]
    Inconsistent {
        /// Their difference after the best rotation.
        difference_px: f64,
        /// By its uncertainty.
        ratio: f64,
        /// Limit of the difference.
        max_px: f64,
        /// Limit of the ratio.
        max_ratio: f64,
    },
    /// The points are not well found.
    #[error(
        "the points are off by {noise_px:.2} px (limit {max_px:.2} px): the pictures are blurred, noisy or too dark; hold the \
         board still, and give it more light"
    )]
    Noisy {
        /// The standard deviation along each axis.
        noise_px: f64,
        /// Its limit.
        max_px: f64,
    },
    /// All is well, and yet it is not enough.
    #[error(
        "the calibration is uncertain by {uncertainty_px:.2} px (limit {max_px:.2} px) at its worst places: take more views, \
         tilted, near, and at the image's border"
    )]
    Uncertain {
        /// One standard deviation of the projection, that 95 % of the image do not exceed.
        uncertainty_px: f64,
        /// Its limit.
        max_px: f64,
    },
}

/// A difference in percent, in words.
fn compared(percent: f64) -> String {
    let comparison = if percent < 0.0 { "smaller" } else { "larger" };
    format!("{:.2} % {comparison}", percent.abs())
}
