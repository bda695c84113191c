//! Computes the light that a camera with a tone curve shows as a grey value.

use imaging::GrayView;

use crate::optics::homography::pixel_bounds;

/// Undoes the tone curve of a [`CameraResponse`](crate::optics::camera_response::CameraResponse) between two grey values.
#[derive(Copy, Clone, Debug)]
pub(crate) struct InverseTone {
    black: f64,
    white: f64,
    curve: f64,
}

impl InverseTone {
    /// Of the curve between the darkest and the brightest pixel of a quad; `None` where it changes nothing.
    pub(crate) fn within(corners: &[[f64; 2]; 4], view: GrayView<'_>, curve: f64) -> Option<Self> {
        if curve == 0.0 {
            return None;
        }
        // The corners go clockwise, so that the inside is on the right of every side.
        let is_inside = |x: f64, y: f64| {
            (0..4).all(|i| {
                let ([ax, ay], [bx, by]) = (corners[i], corners[(i + 1) % 4]);
                (bx - ax) * (y - ay) - (by - ay) * (x - ax) >= 0.0
            })
        };
        let (mut black, mut white) = (u8::MAX, u8::MIN);
        let [left, top, right, bottom] = pixel_bounds(corners, view);
        for y in top..=bottom {
            for (x, grey) in view.row(y).iter().enumerate().take(right + 1).skip(left) {
                if is_inside(x as f64, y as f64) {
                    (black, white) = (black.min(*grey), white.max(*grey));
                }
            }
        }
        let [black, white] = [black, white].map(f64::from);
        (white > black).then_some(Self { black, white, curve })
    }

    /// The light of a grey value, as the grey value of a linear camera that shows black and white alike. Values beyond them, as
    /// a brighter place of the quiet zone, counts as black or white.
    fn light(&self, grey: u8) -> f64 {
        let Self { black, white, curve } = *self;
        let shown = ((f64::from(grey) - black) / (white - black)).clamp(0.0, 1.0);
        black + (white - black) * shown / (1.0 + curve - curve * shown)
    }
}

/// The light of a grey value; the value itself without a tone curve.
#[inline]
pub(crate) fn light_of(tone: Option<&InverseTone>, grey: u8) -> f64 {
    tone.map_or(f64::from(grey), |tone| tone.light(grey))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::optics::camera_response::CameraResponse;

    #[test]
    fn it_undoes_the_response_of_a_camera() {
        let response = CameraResponse { curve: 3.0, sharpening: 0.0 };
        let shown: Vec<u8> = (0..=100_u8)
            .map(|step| {
                let light = f64::from(step) / 100.0;
                (20.0 + 200.0 * response.shown(light, light, 1.0).white).round() as u8
            })
            .collect();
        let view = GrayView::packed(&shown, shown.len(), 1).unwrap();
        let corners = [[0.0, -1.0], [100.0, -1.0], [100.0, 1.0], [0.0, 1.0]];
        assert!(InverseTone::within(&corners, view, 0.0).is_none());
        let tone = InverseTone::within(&corners, view, 3.0).unwrap();
        for (step, grey) in shown.iter().enumerate() {
            let light = 20.0 + 2.0 * step as f64;
            // A level of the brightest tones is four of light.
            assert!((tone.light(*grey) - light).abs() < 2.1, "{step}");
        }
    }
}
