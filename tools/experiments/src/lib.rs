//! The thesis' experiments, wider: markers in rendered frames (section 4.3), and landings (section 4.4) by the hundred.
//!
//! It stands above the services: it calls their pure parts as functions, and knows no network and no clock.
//!
//! Modules in reading order: [`markers`] is the experiment with markers. [`shot`] takes one frame; [`sets`] says which
//! frames there are; [`store`] keeps them on disk; [`record`] is what a detector answers; [`score`] how good that is;
//! [`photographs`] asks real pictures; [`report`] writes it down, [`tables`] and [`figures`] as the [`thesis`] did.
//! [`landing`] is the experiment with landings.

pub mod figures;
pub mod landing;
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
