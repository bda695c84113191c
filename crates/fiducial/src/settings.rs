//! Defines the settings of the detector.

use crate::response::ResponseSetting;

/// Settings of a detector.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct Settings {
    /// T of Equation 3.3, in grey levels, for `rings-thesis`. The thesis does not state it; with 70 most markers are found in
    /// renderings of its camera.
    pub thesis_threshold: u8,
    /// Whether markers printed white on black are detected as well; `rings-thesis` has none.
    pub inverted: bool,
    /// Whether the fallback passes also run in images in which markers were found. Otherwise they run where none was found
    /// and, for families of any id, where two were found, as on boards. The pass for a shadow's edge runs only where none was found.
    pub thorough: bool,
    /// How the camera shows light.
    pub response: ResponseSetting,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            thesis_threshold: 70,
            inverted: true,
            thorough: false,
            response: ResponseSetting::Auto,
        }
    }
}
