//! Parses names and settings.

use markers::{Marker, Pad};
use node::{Layers, Settings};

use crate::files::written;

/// Maximum number of settings that are tried of one input.
const MAX_SETTINGS: usize = 16;

/// The description of a pad.
pub fn pad(input: &[u8]) {
    let Ok(text) = std::str::from_utf8(input) else { return };
    let read = |_: &str| Ok::<_, std::io::Error>(text.to_owned());
    if let Ok(pad) = Pad::named("fuzz.toml", read) {
        assert!(pad.tolerance_m().is_finite() && !pad.markers().is_empty());
        if let Some(drawing) = pad.drawing() {
            let _ = drawing;
        }
    }
}

/// A configuration file of each service, and single settings.
pub fn configuration(input: &[u8]) {
    let Ok(text) = std::str::from_utf8(input) else { return };
    let path = written(input, "toml");
    let settings: Vec<String> = text.lines().take(MAX_SETTINGS).map(str::to_owned).collect();
    for layers in
        [Layers { file: Some(path), set: Vec::new() }, Layers { file: None, set: settings }]
    {
        load::<controller::Config>(&layers);
        load::<detector::Config>(&layers);
        load::<camera_pub::Config>(&layers);
        load::<gcs_bridge::Config>(&layers);
        load::<recorder::Config>(&layers);
        load::<dashboard::Config>(&layers);
        load::<simulator::Config>(&layers);
    }
}

fn load<C: Settings>(layers: &Layers) {
    match layers.load::<C>() {
        Ok(_) => {}
        // A refusal has a reason.
        Err(problem) => assert!(!problem.to_string().is_empty()),
    }
}

/// The name of a marker.
pub fn marker(input: &[u8]) {
    let Ok(text) = std::str::from_utf8(input) else { return };
    if let Ok(marker) = text.parse::<Marker>() {
        // Its written name names the same marker.
        assert_eq!(marker.to_string().parse::<Marker>().as_ref(), Ok(&marker));
        assert!(marker.name().parse::<Marker>().is_ok());
    }
}
