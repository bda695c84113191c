//! Renders exactly for tests: pictures of square markers whose edges lie where they should to a few thousandths of a pixel:
//! along each of many lines through a pixel the edges are found exactly, and the pixel's box and the lens' Gaussian are
//! integrated in closed form.
#![allow(dead_code, reason = "each test uses its own part of it")]
#![allow(clippy::unwrap_used, reason = "a test may stop anywhere")]
#![allow(clippy::print_stdout, reason = "the tests print their figures")]

pub(crate) mod errors;

use fiducial::refine::pattern::Pattern;
use geometry::{Camera, CameraModel, Marker as MarkerFrame, Pixel, Point, Transform};
use imaging::GrayImage;
use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};

/// A square marker before a camera.
#[derive(Clone, Debug)]
pub(crate) struct Scene {
    pub(crate) camera: CameraModel,
    pub(crate) camera_from_marker: Transform<Camera, MarkerFrame>,
    pub(crate) size_m: f64,
    pub(crate) cells: usize,
    /// White cells within the border, row by row.
    pub(crate) word: u64,
    /// Black and white change places.
    pub(crate) inverted: bool,
    /// Cells of paper around the square.
    pub(crate) paper: f64,
    pub(crate) black: f64,
    pub(crate) white: f64,
    pub(crate) ground: f64,
    pub(crate) blur_px: f64,
    /// Standard deviation of the noise in the dark, and noise variance per grey level of light.
    pub(crate) read_noise: f64,
    pub(crate) shot_noise: f64,
    pub(crate) seed: u64,
    /// A straight shadow through the marker's middle takes this fraction of the light, over an edge two pixels wide.
    pub(crate) shadow: f64,
    /// A grey patch hides the marker's first corner and a quarter of two of its sides.
    pub(crate) covered: bool,
}

impl Scene {
    /// A marker near the camera's axis, at a random place and turn, tilted in a random direction.
    pub(crate) fn new(camera: CameraModel, range_m: f64, tilt: f64, seed: u64) -> Self {
        let mut random = Random::new(seed);
        let aside = [0.12 * random.between(-1.0, 1.0), 0.09 * random.between(-1.0, 1.0)];
        let (towards, turn) = (random.between(0.0, 6.3), random.between(0.0, 6.3));
        let facing = UnitQuaternion::from_euler_angles(std::f64::consts::PI, 0.0, turn);
        let axis = Vector3::new(-towards.sin(), towards.cos(), 0.0) * tilt;
        let place = Translation3::new(aside[0] * range_m, aside[1] * range_m, range_m);
        let pose = Isometry3::from_parts(place, UnitQuaternion::from_scaled_axis(axis) * facing);
        Self {
            camera,
            camera_from_marker: Transform::from_isometry(pose),
            size_m: 0.15341,
            cells: 6,
            word: random.next() | 1,
            inverted: false,
            paper: 1.0,
            black: 25.0,
            white: 205.0,
            ground: 70.0,
            blur_px: 0.6,
            read_noise: 1.2,
            shot_noise: 0.015,
            seed,
            shadow: 0.0,
            covered: false,
        }
    }

    /// The print of its square and one cell around it.
    pub(crate) fn pattern(&self) -> Pattern {
        Pattern::new(self.cells, 1, |x, y| Some(self.is_white(x, y))).unwrap()
    }

    fn is_white(&self, x: i32, y: i32) -> bool {
        let last = self.cells as i32 - 1;
        let outside = x.min(y) < 0 || x.max(y) > last;
        let border = x.min(y) == 0 || x.max(y) == last;
        let white = if outside || border {
            outside
        } else {
            self.word >> ((y - 1) * (last - 1) + x - 1) & 1 == 1
        };
        white != self.inverted
    }

    pub(crate) fn project(&self, x_m: f64, y_m: f64) -> Pixel {
        self.camera.project(self.camera_from_marker * Point::new(x_m, y_m, 0.0)).unwrap()
    }

    pub(crate) fn corners(&self) -> [Pixel; 4] {
        let half = self.size_m / 2.0;
        [[-half, half], [half, half], [half, -half], [-half, -half]]
            .map(|[x, y]| self.project(x, y))
    }

    pub(crate) fn centre(&self) -> Pixel {
        self.project(0.0, 0.0)
    }

    /// The corners as something coarse would give them, off by up to `max_px` in x and in y.
    pub(crate) fn coarse(&self, max_px: f64) -> [Pixel; 4] {
        let mut random = Random::new(self.seed ^ 0xabcd);
        self.corners().map(|corner| {
            Pixel::new(
                corner.x + random.between(-max_px, max_px),
                corner.y + random.between(-max_px, max_px),
            )
        })
    }

    /// Light at a place of the image before the lens blurs it.
    fn light(&self, marker_from_camera: &Transform<MarkerFrame, Camera>, x: f64, y: f64) -> f64 {
        let ray = *marker_from_camera * self.camera.unproject_clamped(Pixel::new(x, y));
        let from = marker_from_camera.origin();
        let along = -from.z() / ray.z();
        let cell = self.size_m / self.cells as f64;
        let column = (from.x() + along * ray.x()) / cell + self.cells as f64 / 2.0;
        let row = self.cells as f64 / 2.0 - (from.y() + along * ray.y()) / cell;
        let size = self.cells as f64;
        if self.covered && column.max(row) < 0.25 * size {
            return 0.5 * (self.black + self.white);
        }
        if column.min(row) < -self.paper || column.max(row) > size + self.paper {
            return self.ground;
        }
        if self.is_white(column.floor() as i32, row.floor() as i32) {
            self.white
        } else {
            self.black
        }
    }

    /// The light that falls on each pixel, without noise.
    pub(crate) fn expose(&self) -> Vec<f64> {
        // Lines per row of pixels.
        const LINES: usize = 24;
        let (width, height) = (self.camera.width as usize, self.camera.height as usize);
        let mut light = vec![self.ground; width * height];
        let reach = 4.5 * self.blur_px + 0.5;
        let corners = self.corners();
        let edge = |of: fn(&Pixel) -> f64, sign: f64| {
            corners.iter().map(|c| sign * of(c)).fold(f64::NEG_INFINITY, f64::max) * sign
        };
        let (left, right) = (edge(|c| c.x, -1.0), edge(|c| c.x, 1.0));
        let (top, bottom) = (edge(|c| c.y, -1.0), edge(|c| c.y, 1.0));
        let pad = 0.5 * (right - left).max(bottom - top) + reach + 2.0;
        let limit = |v: f64, end: usize| v.clamp(0.0, end as f64 - 1.0) as usize;
        let (first, last) = (limit(left - pad, width), limit(right + pad, width));
        let (upper, lower) = (limit(top - pad, height), limit(bottom + pad, height));
        for row in &mut light.chunks_mut(width).skip(upper).take(lower - upper + 1) {
            row[first..=last].fill(0.0);
        }
        let marker_from_camera = self.camera_from_marker.inverse();
        let mut line = vec![0.0; last - first + 1];
        let lines = ((lower - upper) as f64 + 1.0 + 2.0 * reach) * LINES as f64;
        for k in 0..lines as usize {
            let y = upper as f64 - 0.5 - reach + (k as f64 + 0.5) / LINES as f64;
            self.line(&marker_from_camera, y, first, &mut line);
            for row in upper..=lower {
                let weight = pixel_share(row as f64 - y, self.blur_px);
                if weight > 0.0 {
                    let row = &mut light[row * width..][first..=last];
                    for (to, from) in row.iter_mut().zip(&line) {
                        *to += weight / LINES as f64 * from;
                    }
                }
            }
        }
        light
    }

    /// One line of the image, blurred along itself.
    fn line(
        &self,
        marker_from_camera: &Transform<MarkerFrame, Camera>,
        y: f64,
        first: usize,
        out: &mut [f64],
    ) {
        const STEP: f64 = 0.34;
        let reach = 4.5 * self.blur_px + 0.5;
        let at = |x: f64| self.light(marker_from_camera, x, y);
        let start = first as f64 - 0.5 - reach;
        let steps = ((out.len() as f64 + 2.0 * reach) / STEP) as usize + 2;
        let mut before = at(start);
        out.fill(before);
        for i in 1..steps {
            let x = start + i as f64 * STEP;
            let here = at(x);
            if (here - before).abs() < 1e-9 {
                continue;
            }
            let (mut low, mut high) = (x - STEP, x);
            for _ in 0..18 {
                let middle = 0.5 * (low + high);
                if (at(middle) - before).abs() < 1e-9 { low = middle } else { high = middle }
            }
            for (column, value) in out.iter_mut().enumerate() {
                let distance = (first + column) as f64 - low;
                *value += (here - before) * box_step(distance, self.blur_px);
            }
            before = here;
        }
    }

    /// The frame with noise, rounded and cut off at the sensor's ends.
    pub(crate) fn developed(&self, light: &[f64], seed: u64) -> GrayImage {
        let (width, height) = (self.camera.width as usize, self.camera.height as usize);
        let mut random = Random::new(seed);
        let mut image = GrayImage::filled(width, height, 0);
        let (sin, cos) = (self.seed as f64).sin_cos();
        let centre = self.centre();
        for (i, (pixel, light)) in image.pixels_mut().iter_mut().zip(light).enumerate() {
            let (x, y) = ((i % width) as f64 - centre.x, (i / width) as f64 - centre.y);
            let light = light * (1.0 - self.shadow * normal(x * cos + y * sin));
            let noise = (self.read_noise.powi(2) + self.shot_noise * light).sqrt();
            *pixel = (light + noise * random.gaussian()).round().clamp(0.0, 255.0) as u8;
        }
        image
    }
}

/// The fraction of a line's light that a pixel `distance` rows away takes, per row.
fn pixel_share(distance: f64, blur: f64) -> f64 {
    normal((distance + 0.5) / blur) - normal((distance - 0.5) / blur)
}

/// A step at 0, blurred and averaged over a pixel whose centre is at `x`.
fn box_step(x: f64, blur: f64) -> f64 {
    if x > 5.0 * blur + 0.5 {
        return 1.0;
    }
    if x < -5.0 * blur - 0.5 {
        return 0.0;
    }
    let area = |x: f64| {
        let z = x / blur;
        x * normal(z) + blur * (-0.5 * z * z).exp() / std::f64::consts::TAU.sqrt()
    };
    area(x + 0.5) - area(x - 0.5)
}

/// The normal distribution by its series.
fn normal(z: f64) -> f64 {
    if z.abs() > 6.0 {
        return f64::from(u8::from(z > 0.0));
    }
    let (mut term, mut sum) = (z, z);
    let mut k = 1.0;
    while term.abs() > 1e-14 * sum.abs() && k < 120.0 {
        term *= z * z / (2.0 * k + 1.0);
        sum += term;
        k += 1.0;
    }
    0.5 + sum * (-0.5 * z * z).exp() / std::f64::consts::TAU.sqrt()
}

/// Numbers that look random (splitmix64).
pub(crate) struct Random(u64);

impl Random {
    pub(crate) fn new(seed: u64) -> Self {
        Self(seed.wrapping_mul(0xd134_2543_de82_ef95).wrapping_add(7))
    }

    pub(crate) fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    pub(crate) fn between(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * (self.next() >> 11) as f64 / (1_u64 << 53) as f64
    }

    pub(crate) fn gaussian(&mut self) -> f64 {
        let radius = (-2.0 * (1.0 - self.between(0.0, 1.0)).ln()).sqrt();
        radius * (std::f64::consts::TAU * self.between(0.0, 1.0)).cos()
    }
}
