//! Sets of views that must be refused, each with the reason it must be refused for.

use geometry::{CameraModel, Distortion};

use calibration::{ImageSize, Lens, Refusal, View};

use super::{SIZE, TAG_M, Taking, Truth, views};

/// A kind of bad set.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub enum Bad {
    TooFew,
    OneDistance,
    NoTilt,
    OneCorner,
    Moving,
    TagSize,
    WrongLens,
    Mirrored,
    MixedSizes,
    Blurred,
    Refocused,
}

impl Bad {
    pub const ALL: [Self; 11] = [
        Self::TooFew,
        Self::OneDistance,
        Self::NoTilt,
        Self::OneCorner,
        Self::Moving,
        Self::TagSize,
        Self::WrongLens,
        Self::Mirrored,
        Self::MixedSizes,
        Self::Blurred,
        Self::Refocused,
    ];

    /// A set of this kind, and the lens that is requested.
    pub fn set(self, truth: &Truth, seed: u64) -> (Vec<View>, Lens) {
        let usual = Taking::default();
        let camera = &truth.camera;
        // Each kind comes in degrees: one just bad enough, one much worse.
        let degree = (seed % 3) as f64;
        let taking = match self {
            Self::TooFew => Taking { views: 3 + 2 * (seed % 3) as usize, ..usual },
            Self::OneDistance => Taking { distances: [0.7, 0.7 + 0.03 * degree], ..usual },
            Self::NoTilt => {
                Taking { is_parallel: true, tilts: [0.0, 0.02 + 0.04 * degree], ..usual }
            }
            Self::OneCorner => {
                let part = [[0.05, 0.3, 0.05, 0.3], [0.7, 0.95, 0.05, 0.3], [0.7, 0.95, 0.7, 0.95]];
                Taking { part: part[(seed % 3) as usize], distances: [1.2, 2.2], ..usual }
            }
            Self::Moving if seed.is_multiple_of(2) => {
                Taking { motion_m: 0.004 + 0.004 * degree, ..usual }
            }
            Self::Moving => Taking { floppy_m: 0.003 + 0.002 * degree, ..usual },
            Self::TagSize => {
                let share = [0.97, 1.01, 1.05][(seed % 3) as usize];
                Taking { tag_m: TAG_M * share, ..usual }
            }
            Self::Blurred => {
                let noise_px = 0.8 + 0.6 * degree;
                Taking { noise_px, tag_noise_px: 0.5 * noise_px, ..usual }
            }
            _ => usual,
        };
        let camera = if self == Self::WrongLens { &truth.described_by_more() } else { camera };
        let mut views = views(camera, &taking, seed);
        match self {
            Self::Mirrored => mirror(&mut views),
            Self::MixedSizes => {
                let other = ImageSize { width: SIZE.width / 2, height: SIZE.height / 2 };
                views[17].size = other;
                views[17]
                    .points
                    .iter_mut()
                    .for_each(|p| (p.seen.x, p.seen.y) = (p.seen.x / 2.0, p.seen.y / 2.0));
            }
            Self::Refocused => {
                // From the middle of the set on; by more than this it looks like motion.
                let other = CameraModel { fx: 1.007 * camera.fx, fy: 1.007 * camera.fy, ..*camera };
                let later = super::views(&other, &taking, seed + 1);
                let middle = views.len() / 2;
                views.truncate(middle);
                views.extend(later.into_iter().skip(middle));
            }
            _ => {}
        }
        (views, if self == Self::WrongLens { truth.wrong_lens() } else { truth.lens })
    }

    /// Whether a refusal names the reason.
    pub fn is_named_by(self, refusal: &Refusal) -> bool {
        match self {
            Self::TooFew => matches!(refusal, Refusal::TooFewViews { .. }),
            Self::OneDistance => matches!(refusal, Refusal::OneDistance { .. }),
            Self::NoTilt => matches!(refusal, Refusal::NoTilt { .. }),
            Self::OneCorner => matches!(refusal, Refusal::PartOfImage { .. }),
            Self::Moving => matches!(refusal, Refusal::Moving { .. }),
            Self::TagSize => matches!(refusal, Refusal::TagSize { .. }),
            Self::WrongLens => {
                matches!(refusal, Refusal::WrongLens { .. } | Refusal::Diverged { .. })
            }
            Self::Mirrored => matches!(refusal, Refusal::Mirrored { .. }),
            Self::MixedSizes => matches!(refusal, Refusal::MixedSizes { .. }),
            Self::Blurred => matches!(refusal, Refusal::Noisy { .. }),
            Self::Refocused => matches!(refusal, Refusal::Inconsistent { .. }),
        }
    }
}

fn mirror(views: &mut [View]) {
    for point in views.iter_mut().flat_map(|view| &mut view.points) {
        point.seen.x = f64::from(SIZE.width) - 1.0 - point.seen.x;
    }
}

impl Truth {
    /// A model that cannot describe it.
    fn wrong_lens(&self) -> Lens {
        match self.lens {
            Lens::BrownConrady5 => Lens::BrownConrady4,
            _ => Lens::BrownConrady5,
        }
    }

    /// The same; a narrow lens, which less would describe as well, with a distortion that turns twice.
    fn described_by_more(&self) -> CameraModel {
        let wavy = Distortion::BrownConrady([-0.35, 0.6, 1e-3, -5e-4, -0.5, 0.0, 0.0, 0.0]);
        let is_narrow = self.lens == Lens::BrownConrady5;
        CameraModel {
            distortion: if is_narrow { wavy } else { self.camera.distortion },
            ..self.camera
        }
    }
}
