//! Computes a velocity from the target: either by [`thesis`] or by [`metric`].

pub mod metric;
pub(crate) mod observer;
mod path;
pub mod situation;
pub mod thesis;

use std::ops::{Deref, DerefMut};

use crate::config::GuidanceConfig;
use metric::Metric;
use situation::Guidance;
use thesis::Thesis;

/// The configured guidance; it is stored in place, so that a new landing allocates nothing.
#[derive(Clone, Debug)]
pub(crate) enum ActiveGuidance {
    Thesis(Thesis),
    Metric(Metric),
}

impl ActiveGuidance {
    pub(crate) fn new(config: GuidanceConfig) -> Self {
        match config {
            GuidanceConfig::Thesis(config) => Self::Thesis(Thesis::new(config)),
            GuidanceConfig::Metric(config) => Self::Metric(Metric::new(config)),
        }
    }
}

impl Deref for ActiveGuidance {
    type Target = dyn Guidance;

    fn deref(&self) -> &Self::Target {
        match self {
            Self::Thesis(thesis) => thesis,
            Self::Metric(metric) => metric,
        }
    }
}

impl DerefMut for ActiveGuidance {
    fn deref_mut(&mut self) -> &mut Self::Target {
        match self {
            Self::Thesis(thesis) => thesis,
            Self::Metric(metric) => metric,
        }
    }
}
