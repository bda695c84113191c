//! Draws the stages of a detection on the image: [`debug`] the marks, on a [`canvas`], with the letters of a [`font`].

pub mod canvas;
pub mod debug;
pub mod font;
