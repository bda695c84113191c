//! The thesis' experiment with markers (section 4.3), wider: sets of rendered frames with truth, detectors run over
//! them, scores, tables and figures.
//!
//! This crate knows cameras, markers and detectors as functions; it knows no vehicle and no network.
//!
//! Modules in reading order: [`shot`] takes one frame, through a [`veil`]; [`sets`] says which frames there are;
//! [`store`] keeps them on disk; [`record`] is what a detector answers; [`score`] how good that is; [`photographs`] asks
//! real pictures; [`report`] writes it down, [`tables`] and [`figures`] as the [`thesis`] did; [`markers`] does all of it.

pub mod figures;
pub mod markers;
pub mod photographs;
pub mod record;
pub mod report;
pub mod score;
pub mod sets;
pub mod shot;
pub mod store;
pub mod tables;
pub mod thesis;
pub mod veil;
