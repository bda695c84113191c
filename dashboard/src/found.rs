//! Describes a detection in a few words.

use messages::Detection;

/// A detected marker in words: its name, size and distance.
pub fn in_words(found: &Detection) -> String {
    let id = found.id.map_or_else(String::new, |id| format!(":{id}"));
    let distance = found.pose.as_ref().map(|pose| {
        let [x, y, z] = pose.camera_from_marker.translation_m;
        format!("{:.2} m away", (x * x + y * y + z * z).sqrt())
    });
    let distance = distance.unwrap_or_else(|| "no pose".to_owned());
    format!("{}{id}, {:.0} px, {distance}", found.family, found.size_px)
}
