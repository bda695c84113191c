//! Reports on a recorded flight: a page, a summary and figures that show the events and their reasons.
//!
//! Recordings in, a page out: HTML that needs no network and no other file, with charts as SVG. This crate uses no
//! files, no clock and no network, and decides nothing: all that it reports of a flight is in the recording.
//!
//! Modules in reading order: [`flight`] has the messages of a recording, with the autopilot's [`packets`], and [`landings`] keeps
//! one landing of it; [`frames`] shows
//! the outcome of each frame, [`latency`] how long it took, [`light`] how bright the pictures were, [`origin`] when it was recorded, [`track`] where the vehicle was,
//! [`phases`] and [`journal`] the events and their reasons, [`losses`] the lost messages, [`tape`] whether the tape gives the same again,
//! and [`mod@summary`] all of it in numbers. [`difference`], over [`settings`], compares configurations. [`view`] joins these for the page:
//! [`plots`] are its charts, drawn by [`chart`], [`sections`] its parts, in pieces of [`html`], and [`mod@page`] the whole,
//! [`mod@document`] the same on the pages of a [`pdf`] file. [`mod@figures`] are the charts as separate files.

pub mod chart;
pub mod difference;
pub mod document;
pub mod figures;
pub mod flight;
pub mod frames;
pub mod html;
pub mod journal;
pub mod landings;
pub mod latency;
pub mod light;
pub mod losses;
pub mod origin;
pub mod packets;
pub mod page;
pub mod pdf;
pub mod phases;
pub mod plots;
pub mod sections;
pub mod settings;
pub mod summary;
pub mod tape;
pub mod track;
pub mod view;

pub use document::document;
pub use figures::{Figure, figures};
pub use flight::{Flight, FlightReader, Replayed};
pub use page::{comparison, marks, page};
pub use summary::Summary;
pub use tape::replay_tapes;

/// A flight in numbers, as the page has them.
pub fn summary(flight: &Flight) -> Summary {
    summary::of(flight, &frames::Frames::of(flight))
}
