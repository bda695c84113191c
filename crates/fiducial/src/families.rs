//! Contains the detectors, one for each kind of marker.

pub(crate) mod family;
pub(crate) mod query;
pub mod rings;
pub mod rings_thesis;
pub(crate) mod square;
pub(crate) mod stag;

use markers::{Family, Marker};

use crate::settings::Settings;
use family::FamilyDetector;
use rings::RingDetector;
use rings_thesis::RingsThesis;
use square::SquareTagDetector;
use stag::StagDetector;

/// The detectors of these markers, in the order in which they run.
pub(crate) fn detectors(markers: &[Marker], settings: Settings) -> Vec<Box<dyn FamilyDetector>> {
    let mut detectors: Vec<Box<dyn FamilyDetector>> = Vec::new();
    let squares = SquareTagDetector::new(markers, settings.inverted);
    if !squares.is_empty() {
        detectors.push(Box::new(squares));
    }
    let stags = StagDetector::new(markers, settings.inverted);
    if !stags.is_empty() {
        detectors.push(Box::new(stags));
    }
    for marker in markers {
        match marker.family {
            Family::Rings => detectors.push(Box::new(RingDetector::new(*marker, settings))),
            Family::RingsThesis => detectors.push(Box::new(RingsThesis::new(*marker, settings))),
            _ => {}
        }
    }
    detectors
}
