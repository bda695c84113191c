//! Renders a small camera's frames for tests: the marker on textured ground, sampled over each pixel's area, with lens blur and
//! noise.
#![allow(dead_code, reason = "each test uses its own part of it")]
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test may stop anywhere")]

use std::sync::OnceLock;

use geometry::{
    Camera, CameraModel, Distortion, Marker as MarkerFrame, Pixel, Point, Rotation, Transform,
};
use imaging::GrayImage;
use markers::{Drawing, Ink, Marker, Shape};

/// Size of the thesis' marker, in metres.
pub(crate) const SIZE_M: f64 = 0.15341;

/// The settings of a rendered frame.
#[derive(Copy, Clone, Debug)]
pub(crate) struct Scene {
    pub(crate) camera: CameraModel,
    pub(crate) camera_from_marker: Transform<Camera, MarkerFrame>,
    /// Grey value of black ink, white paper, and the ground's mean.
    pub(crate) black: f64,
    pub(crate) white: f64,
    pub(crate) ground: f64,
    /// Half the ground texture's range, in grey levels.
    pub(crate) texture: f64,
    /// Half the edge of the paper, in units of the marker's size.
    pub(crate) paper: f64,
    /// Standard deviation of the lens blur in pixels, of the noise in grey levels.
    pub(crate) blur_px: f64,
    pub(crate) noise: f64,
    pub(crate) seed: u64,
}

impl Scene {
    /// The marker seen from `range_m` along the axis through (x, y) metres at that range, tilted by `tilt` radians in
    /// direction `towards`.
    pub(crate) fn new(camera: CameraModel, place_m: [f64; 3], tilt: f64, towards: f64) -> Self {
        Self {
            camera,
            camera_from_marker: pose(place_m, tilt, towards),
            black: 25.0,
            white: 215.0,
            ground: 110.0,
            texture: 40.0,
            paper: 0.7,
            blur_px: 0.5,
            noise: 1.5,
            seed: 1,
        }
    }

    /// Where the marker's centre is in the image.
    pub(crate) fn centre(&self) -> Pixel {
        self.camera.project(self.camera_from_marker.origin()).unwrap()
    }

    /// Distance of the marker's centre from the camera, in metres.
    pub(crate) fn range_m(&self) -> f64 {
        self.camera_from_marker.origin().coords.coords.norm()
    }

    /// The frame. Around the marker every pixel is the mean over its area, blurred by the lens; further away the
    /// ground is a texture without fine detail.
    pub(crate) fn render(&self) -> GrayImage {
        let (width, height) = (self.camera.width as usize, self.camera.height as usize);
        let mut random = Random(self.seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1);
        let noise: Vec<f64> = (0..4093).map(|_| self.noise * random.gaussian()).collect();
        let texture = texture();
        let shift = self.seed as usize * 37;
        let mut image = GrayImage::filled(width, height, 0);
        for y in 0..height {
            for (x, pixel) in image.row_mut(y).iter_mut().enumerate() {
                let light = self.ground + self.texture * texture[y % 256 * 256 + (x + shift) % 256];
                *pixel = self.developed(light, noise[(y * width + x) % 4093]);
            }
        }
        let area = self.area_of_marker();
        let light = self.expose(area, texture);
        let columns = (area[2] - area[0]) as usize;
        for (i, light) in light.into_iter().enumerate() {
            let (x, y) = (area[0] + (i % columns) as i64, area[1] + (i / columns) as i64);
            let (Ok(x), Ok(y)) = (usize::try_from(x), usize::try_from(y)) else { continue };
            if x < width && y < height {
                image.row_mut(y)[x] = self.developed(light, noise[(y * width + x) % 4093]);
            }
        }
        image
    }

    /// From pixels to places in the marker's plane.
    fn places(&self) -> impl Fn(f64, f64) -> (f64, f64) {
        let marker_from_camera = self.camera_from_marker.inverse();
        let from = marker_from_camera.origin().coords;
        let turn = marker_from_camera.rotation().quaternion.to_rotation_matrix();
        let camera = self.camera;
        move |x, y| {
            let direction = turn
                * match camera.distortion {
                    Distortion::None => nalgebra::Vector3::new(
                        (x - camera.cx) / camera.fx,
                        (y - camera.cy) / camera.fy,
                        1.0,
                    ),
                    _ => camera.unproject_clamped(Pixel::new(x, y)).coords,
                };
            let along = -from.z / direction.z;
            (from.x + along * direction.x, from.y + along * direction.y)
        }
    }

    fn developed(&self, light: f64, noise: f64) -> u8 {
        (light + noise).round().clamp(0.0, 255.0) as u8
    }

    /// First and last column and row around the paper, beyond the image's edge by the blur's reach only; the whole image where the
    /// lens model does not reach all of the paper.
    fn area_of_marker(&self) -> [i64; 4] {
        let half = self.paper * SIZE_M;
        let limits = [f64::from(self.camera.width), f64::from(self.camera.height)];
        let mut area = [f64::MAX, f64::MAX, f64::MIN, f64::MIN];
        for i in 0..32 {
            let t = f64::from(i) * std::f64::consts::TAU / 32.0;
            let corner = Point::<MarkerFrame>::new(1.5 * half * t.cos(), 1.5 * half * t.sin(), 0.0);
            let Some(at) = self.camera.project(self.camera_from_marker * corner) else {
                area = [0.0, 0.0, limits[0], limits[1]];
                break;
            };
            area = [area[0].min(at.x), area[1].min(at.y), area[2].max(at.x), area[3].max(at.y)];
        }
        let edge = |value: f64, axis: usize| value.clamp(-9.0, limits[axis] + 9.0) as i64;
        [edge(area[0], 0), edge(area[1], 1), edge(area[2], 0) + 1, edge(area[3], 1) + 1]
    }

    fn expose(&self, area: [i64; 4], texture: &[f64]) -> Vec<f64> {
        let discs = discs();
        let place = self.places();
        // The surface at a point, paper or ground, and its brightness.
        let shade = |x: f64, y: f64| {
            let (px, py) = place(x, y);
            if px.abs().max(py.abs()) >= self.paper * SIZE_M {
                let wrapped = |v: f64| v.rem_euclid(256.0) as usize % 256;
                let value = texture[wrapped(y) * 256 + wrapped(x)];
                return (false, self.ground + self.texture * value);
            }
            let square = px * px + py * py;
            match discs.iter().find(|(radius_m, _)| square <= radius_m * radius_m) {
                Some((_, Ink::Black)) => (true, self.black),
                _ => (true, self.white),
            }
        };
        let (columns, rows) = ((area[2] - area[0]) as usize, (area[3] - area[1]) as usize);
        // Where nothing changes within the blur's reach there is nothing to average. Small markers are all edges.
        let reach = 1.0 + 4.0 * self.blur_px;
        let around = [(-reach, -reach), (reach, -reach), (-reach, reach), (reach, reach)];
        let side = if columns > 300 { 6 } else { 12 };
        let offset = |i: i32| (f64::from(i) + 0.5) / f64::from(side) - 0.5;
        let (mut light, mut edges) = (Vec::with_capacity(columns * rows), Vec::new());
        for y in area[1]..area[3] {
            for x in area[0]..area[2] {
                let (x, y) = (x as f64, y as f64);
                let (paper, value) = shade(x, y);
                let alike = |(dx, dy): &(f64, f64)| {
                    let other = shade(x + dx, y + dy);
                    other.0 == paper && (!paper || (other.1 - value).abs() < 1e-9)
                };
                if columns > 100 && around.iter().all(alike) {
                    light.push(value);
                    continue;
                }
                edges.push(light.len());
                let spots =
                    (0..side * side).map(|i| shade(x + offset(i % side), y + offset(i / side)).1);
                light.push(spots.sum::<f64>() / f64::from(side * side));
            }
        }
        blurred(&light, columns, &edges, self.blur_px)
    }
}

/// The drawing's discs, smallest first: radius in metres and ink.
fn discs() -> Vec<(f64, Ink)> {
    let drawing = Drawing::new(&"rings".parse::<Marker>().unwrap(), SIZE_M).unwrap();
    let disc = |layer: &markers::Layer| match layer.shape {
        Shape::Disc { radius_m, .. } => (radius_m, layer.ink),
        Shape::Rectangle { .. } => panic!("rings are discs"),
    };
    drawing.layers.iter().rev().map(disc).collect()
}

/// The marker at a place in the camera frame, its face tilted away from squarely facing the camera.
pub(crate) fn pose(place_m: [f64; 3], tilt: f64, towards: f64) -> Transform<Camera, MarkerFrame> {
    let facing = Rotation::<Camera, MarkerFrame>::from_euler(std::f64::consts::PI, 0.0, 0.0);
    let axis = nalgebra::Vector3::new(-towards.sin(), towards.cos(), 0.0) * tilt;
    let turn = nalgebra::UnitQuaternion::from_scaled_axis(axis);
    Transform::new(
        Rotation::from_quaternion(turn * facing.quaternion),
        Point::new(place_m[0], place_m[1], place_m[2]),
    )
}

/// Ground of 256 x 256 pixels that varies from -1 to 1 on several scales.
fn texture() -> &'static [f64] {
    static TEXTURE: OnceLock<Vec<f64>> = OnceLock::new();
    TEXTURE.get_or_init(|| {
        let at = |i: u32| {
            let (x, y) = (f64::from(i % 256), f64::from(i / 256));
            [(64.0, 0.3), (16.0, 0.3), (5.0, 0.25), (2.0, 0.15)]
                .iter()
                .map(|(scale, part)| part * lattice(x / scale, y / scale))
                .sum()
        };
        (0..256 * 256).map(at).collect()
    })
}

/// Smooth noise from -1 to 1 with one value per unit square's corner.
fn lattice(x: f64, y: f64) -> f64 {
    let corner = |i: f64, j: f64| {
        let key = (i as i64 as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15)
            ^ (j as i64 as u64).wrapping_mul(0xc2b2_ae3d_27d4_eb4f);
        Random(key | 1).after(3) * 2.0 - 1.0
    };
    let (i, j) = (x.floor(), y.floor());
    let ease = |t: f64| t * t * (3.0 - 2.0 * t);
    let (u, v) = (ease(x - i), ease(y - j));
    let across = |row: f64| corner(i, row) * (1.0 - u) + corner(i + 1.0, row) * u;
    across(j) * (1.0 - v) + across(j + 1.0) * v
}

/// Gaussian blur of the pixels at `edges`.
fn blurred(light: &[f64], width: usize, edges: &[usize], sigma: f64) -> Vec<f64> {
    let mut out = light.to_vec();
    if sigma <= 0.0 {
        return out;
    }
    let height = light.len() / width;
    let reach = (4.0 * sigma).ceil() as isize;
    let weights: Vec<f64> =
        (-reach..=reach).map(|d| (-(d * d) as f64 / (2.0 * sigma * sigma)).exp()).collect();
    let near =
        |at: usize, d: isize, len: usize| (at as isize + d).clamp(0, len as isize - 1) as usize;
    for edge in edges {
        let (x, y) = (edge % width, edge / width);
        let (mut sum, mut total) = (0.0, 0.0);
        for (dy, wy) in (-reach..).zip(&weights) {
            let row = &light[near(y, dy, height) * width..][..width];
            for (dx, wx) in (-reach..).zip(&weights) {
                sum += wx * wy * row[near(x, dx, width)];
                total += wx * wy;
            }
        }
        out[*edge] = sum / total;
    }
    out
}

/// Numbers that look random (xorshift64*).
pub(crate) struct Random(pub(crate) u64);

impl Random {
    pub(crate) fn uniform(&mut self) -> f64 {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        (self.0.wrapping_mul(0x2545_f491_4f6c_dd1d) >> 11) as f64 / (1_u64 << 53) as f64
    }

    fn after(mut self, skipped: u32) -> f64 {
        for _ in 0..skipped {
            self.uniform();
        }
        self.uniform()
    }

    pub(crate) fn gaussian(&mut self) -> f64 {
        let radius = (-2.0 * (1.0 - self.uniform()).ln()).sqrt();
        radius * (std::f64::consts::TAU * self.uniform()).cos()
    }
}
