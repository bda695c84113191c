//! Defines points, vectors, rotations and rigid transforms that carry their coordinate frames.

use std::marker::PhantomData;
use std::ops::{Add, Mul, Neg, Sub};

use nalgebra::{Isometry3, Point3, Quaternion, Translation3, UnitQuaternion, Vector3};

use crate::frame::{Body, Frame, Ned};

/// A place, in metres, in frame `F`.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct Point<F: Frame> {
    /// The coordinates in metres.
    pub coords: Point3<f64>,
    frame: PhantomData<F>,
}

/// A direction with a length (displacement, velocity, ...) in frame `F`.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct Vector<F: Frame> {
    /// The components; the unit is the quantity's (m, m/s, ...).
    pub coords: Vector3<f64>,
    frame: PhantomData<F>,
}

/// A rotation that takes coordinates in `From` to coordinates in `To`.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct Rotation<To: Frame, From: Frame> {
    /// The rotation as a unit quaternion.
    pub quaternion: UnitQuaternion<f64>,
    frames: PhantomData<(To, From)>,
}

/// A rigid transform that takes coordinates in `From` to coordinates in `To`; name it `to_from_from`.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct Transform<To: Frame, From: Frame> {
    /// The rotation followed by the translation.
    pub isometry: Isometry3<f64>,
    frames: PhantomData<(To, From)>,
}

impl<F: Frame> Point<F> {
    /// The point with these coordinates in metres.
    pub fn new(x: f64, y: f64, z: f64) -> Self {
        Self::from_coords(Point3::new(x, y, z))
    }

    /// The frame's origin.
    pub fn origin() -> Self {
        Self::new(0.0, 0.0, 0.0)
    }

    /// Tags coordinates with their frame.
    pub fn from_coords(coords: Point3<f64>) -> Self {
        Self { coords, frame: PhantomData }
    }

    /// First coordinate, in metres.
    pub fn x(&self) -> f64 {
        self.coords.x
    }

    /// Second coordinate, in metres.
    pub fn y(&self) -> f64 {
        self.coords.y
    }

    /// Third coordinate, in metres.
    pub fn z(&self) -> f64 {
        self.coords.z
    }

    /// True when no coordinate is infinite or not a number.
    pub fn is_finite(&self) -> bool {
        self.coords.iter().all(|c| c.is_finite())
    }
}

impl<F: Frame> Vector<F> {
    /// The vector with these components.
    pub fn new(x: f64, y: f64, z: f64) -> Self {
        Self::from_coords(Vector3::new(x, y, z))
    }

    /// The zero vector.
    pub fn zero() -> Self {
        Self::new(0.0, 0.0, 0.0)
    }

    /// Tags components with their frame.
    pub fn from_coords(coords: Vector3<f64>) -> Self {
        Self { coords, frame: PhantomData }
    }

    /// First component.
    pub fn x(&self) -> f64 {
        self.coords.x
    }

    /// Second component.
    pub fn y(&self) -> f64 {
        self.coords.y
    }

    /// Third component.
    pub fn z(&self) -> f64 {
        self.coords.z
    }

    /// Euclidean length.
    pub fn norm(&self) -> f64 {
        self.coords.norm()
    }

    /// Length of the first two components: the horizontal part in [`crate::Ned`].
    pub fn horizontal_norm(&self) -> f64 {
        self.coords.xy().norm()
    }

    /// True when no component is infinite or not a number.
    pub fn is_finite(&self) -> bool {
        self.coords.iter().all(|c| c.is_finite())
    }
}

impl<To: Frame, From: Frame> Rotation<To, From> {
    /// Tags a unit quaternion with its frames.
    pub fn from_quaternion(quaternion: UnitQuaternion<f64>) -> Self {
        Self { quaternion, frames: PhantomData }
    }

    /// From w, x, y, z, normalised; `None` when the length is zero or not finite.
    pub fn from_wxyz(wxyz: [f64; 4]) -> Option<Self> {
        let [w, x, y, z] = wxyz;
        let quaternion = Quaternion::new(w, x, y, z);
        let norm = quaternion.norm();
        (norm.is_finite() && norm > 1e-9)
            .then(|| Self::from_quaternion(UnitQuaternion::from_quaternion(quaternion)))
    }

    /// From aerospace Euler angles in radians (yaw about z, then pitch about y, then roll about x).
    pub fn from_euler(roll: f64, pitch: f64, yaw: f64) -> Self {
        Self::from_quaternion(UnitQuaternion::from_euler_angles(roll, pitch, yaw))
    }

    /// From a rotation vector: its direction is the axis, its length the angle in radians.
    pub fn from_rotation_vector(vector: Vector<From>) -> Self {
        Self::from_quaternion(UnitQuaternion::from_scaled_axis(vector.coords))
    }

    /// Aerospace Euler angles (roll, pitch, yaw) in radians.
    pub fn euler(&self) -> (f64, f64, f64) {
        self.quaternion.euler_angles()
    }

    /// The quaternion's components w, x, y, z.
    pub fn wxyz(&self) -> [f64; 4] {
        let q = self.quaternion;
        [q.w, q.i, q.j, q.k]
    }

    /// The rotation that leaves everything where it is.
    pub fn identity() -> Self {
        Self::from_quaternion(UnitQuaternion::identity())
    }

    /// The rotation in the other direction.
    pub fn inverse(&self) -> Rotation<From, To> {
        Rotation::from_quaternion(self.quaternion.inverse())
    }

    /// Spherical interpolation towards `other`; `fraction` 0 gives `self`, 1 gives `other`.
    pub fn interpolate(&self, other: &Self, fraction: f64) -> Self {
        // `slerp` has no answer for opposite rotations; the nearer end is then as good as any.
        let between = self.quaternion.try_slerp(&other.quaternion, fraction, 1e-9);
        Self::from_quaternion(between.unwrap_or(if fraction < 0.5 {
            self.quaternion
        } else {
            other.quaternion
        }))
    }

    /// Angle of the rotation, in radians, from 0 to pi.
    pub fn angle(&self) -> f64 {
        self.quaternion.angle()
    }
}

impl Rotation<Ned, Body> {
    /// The direction of the body's down axis: straight down, (0, 0, 1), when the vehicle is level.
    pub fn down_axis(&self) -> Vector<Ned> {
        *self * Vector::<Body>::new(0.0, 0.0, 1.0)
    }
}

impl<To: Frame, From: Frame> Transform<To, From> {
    /// From the rotation and from the origin of `From` as seen in `To`.
    pub fn new(rotation: Rotation<To, From>, origin_in_to: Point<To>) -> Self {
        Self::from_isometry(Isometry3::from_parts(
            Translation3::from(origin_in_to.coords.coords),
            rotation.quaternion,
        ))
    }

    /// Tags an isometry with its frames.
    pub fn from_isometry(isometry: Isometry3<f64>) -> Self {
        Self { isometry, frames: PhantomData }
    }

    /// The transform that leaves everything where it is.
    pub fn identity() -> Self {
        Self::from_isometry(Isometry3::identity())
    }

    /// The transform in the other direction.
    pub fn inverse(&self) -> Transform<From, To> {
        Transform::from_isometry(self.isometry.inverse())
    }

    /// The rotation part.
    pub fn rotation(&self) -> Rotation<To, From> {
        Rotation::from_quaternion(self.isometry.rotation)
    }

    /// Where the origin of `From` is, seen in `To`.
    pub fn origin(&self) -> Point<To> {
        Point::from_coords(Point3::from(self.isometry.translation.vector))
    }
}

impl<A: Frame, B: Frame, C: Frame> Mul<Transform<B, C>> for Transform<A, B> {
    type Output = Transform<A, C>;
    fn mul(self, rhs: Transform<B, C>) -> Transform<A, C> {
        Transform::from_isometry(self.isometry * rhs.isometry)
    }
}

impl<A: Frame, B: Frame> Mul<Point<B>> for Transform<A, B> {
    type Output = Point<A>;
    fn mul(self, rhs: Point<B>) -> Point<A> {
        Point::from_coords(self.isometry * rhs.coords)
    }
}

impl<A: Frame, B: Frame> Mul<Vector<B>> for Transform<A, B> {
    type Output = Vector<A>;
    fn mul(self, rhs: Vector<B>) -> Vector<A> {
        Vector::from_coords(self.isometry.rotation * rhs.coords)
    }
}

impl<A: Frame, B: Frame, C: Frame> Mul<Rotation<B, C>> for Rotation<A, B> {
    type Output = Rotation<A, C>;
    fn mul(self, rhs: Rotation<B, C>) -> Rotation<A, C> {
        Rotation::from_quaternion(self.quaternion * rhs.quaternion)
    }
}

impl<A: Frame, B: Frame> Mul<Vector<B>> for Rotation<A, B> {
    type Output = Vector<A>;
    fn mul(self, rhs: Vector<B>) -> Vector<A> {
        Vector::from_coords(self.quaternion * rhs.coords)
    }
}

impl<F: Frame> Sub for Point<F> {
    type Output = Vector<F>;
    fn sub(self, rhs: Self) -> Vector<F> {
        Vector::from_coords(self.coords - rhs.coords)
    }
}

impl<F: Frame> Add<Vector<F>> for Point<F> {
    type Output = Self;
    fn add(self, rhs: Vector<F>) -> Self {
        Self::from_coords(self.coords + rhs.coords)
    }
}

impl<F: Frame> Sub<Vector<F>> for Point<F> {
    type Output = Self;
    fn sub(self, rhs: Vector<F>) -> Self {
        Self::from_coords(self.coords - rhs.coords)
    }
}

impl<F: Frame> Add for Vector<F> {
    type Output = Self;
    fn add(self, rhs: Self) -> Self {
        Self::from_coords(self.coords + rhs.coords)
    }
}

impl<F: Frame> Sub for Vector<F> {
    type Output = Self;
    fn sub(self, rhs: Self) -> Self {
        Self::from_coords(self.coords - rhs.coords)
    }
}

impl<F: Frame> Neg for Vector<F> {
    type Output = Self;
    fn neg(self) -> Self {
        Self::from_coords(-self.coords)
    }
}

impl<F: Frame> Mul<f64> for Vector<F> {
    type Output = Self;
    fn mul(self, rhs: f64) -> Self {
        Self::from_coords(self.coords * rhs)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frame::Camera;
    use proptest::prelude::*;

    fn transform(r: [f64; 3], t: [f64; 3]) -> Transform<Ned, Body> {
        Transform::new(Rotation::from_euler(r[0], r[1], r[2]), Point::new(t[0], t[1], t[2]))
    }

    proptest! {
        #[test]
        fn a_transform_and_its_inverse_cancel(
            r in prop::array::uniform3(-3.0..3.0f64),
            t in prop::array::uniform3(-100.0..100.0f64),
            p in prop::array::uniform3(-100.0..100.0f64),
        ) {
            let ned_from_body = transform(r, t);
            let point = Point::<Body>::new(p[0], p[1], p[2]);
            let back = ned_from_body.inverse() * (ned_from_body * point);
            prop_assert!((back - point).norm() < 1e-9);
        }

        #[test]
        fn a_quaternion_survives_its_components(r in prop::array::uniform3(-1.5..1.5f64)) {
            let rotation = Rotation::<Ned, Body>::from_euler(r[0], r[1], r[2]);
            let again = Rotation::<Ned, Body>::from_wxyz(rotation.wxyz()).unwrap();
            prop_assert!((rotation.inverse() * Rotation::<Ned, Ned>::identity() * again).angle() < 1e-7);
        }
    }

    #[test]
    fn a_vehicle_that_rolls_right_has_its_down_axis_to_the_left() {
        let level = Rotation::<Ned, Body>::from_euler(0.0, 0.0, 0.7);
        assert!((level.down_axis() - Vector::new(0.0, 0.0, 1.0)).norm() < 1e-12);
        let rolled = Rotation::<Ned, Body>::from_euler(0.1, 0.0, 0.0);
        let (sin, cos) = 0.1_f64.sin_cos();
        assert!((rolled.down_axis() - Vector::new(0.0, -sin, cos)).norm() < 1e-12);
    }

    #[test]
    fn a_camera_that_looks_down_sees_the_nose_at_the_top_of_its_image() {
        // Image up is forward: camera x (right) is body y, camera y (down) is body -x, camera z is body z.
        let body_from_camera =
            Rotation::<Body, Camera>::from_euler(0.0, 0.0, std::f64::consts::FRAC_PI_2);
        let up_in_image = body_from_camera * Vector::<Camera>::new(0.0, -1.0, 0.0);
        assert!((up_in_image - Vector::new(1.0, 0.0, 0.0)).norm() < 1e-12);
        let ahead = body_from_camera * Vector::<Camera>::new(0.0, 0.0, 1.0);
        assert!((ahead - Vector::new(0.0, 0.0, 1.0)).norm() < 1e-12);
    }

    #[test]
    fn a_quaternion_of_no_length_is_refused() {
        assert!(Rotation::<Ned, Body>::from_wxyz([0.0; 4]).is_none());
        assert!(Rotation::<Ned, Body>::from_wxyz([f64::NAN, 0.0, 0.0, 1.0]).is_none());
    }
}
