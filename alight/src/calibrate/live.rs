//! Takes frames of a running camera until enough of them show the board, and shows which views are still missing.

use anyhow::{Context, ensure};
use calibration::calibrate_unjudged;
use imaging::Converter;
use messages::{FrameHeader, topic};
use node::{Frame, Node, Shutdown};

use super::args::BoardArgs;
use super::found::{Finder, FoundImages, Origin, Picture};
use super::shown::Shown;
use crate::args::Format;
use crate::grey::grey;
use crate::runtime::with_node;
use crate::terminal::{print, write_error};

/// Without a frame for this time, the camera counts as absent.
const FRAME_TIMEOUT: std::time::Duration = std::time::Duration::from_secs(10);
/// After this many further views the initial solution is computed again.
const VIEWS_PER_SOLUTION: usize = 4;

/// Takes frames in which the board has moved and is held still, and shows which view is needed next, until no view is missing or the user
/// ends it (Ctrl-C).
///
/// # Errors
/// When no frames come, or the network cannot be joined.
pub(super) fn watch_camera(
    finder: &mut Finder<'_>,
    camera: &str,
    args: &BoardArgs,
) -> anyhow::Result<FoundImages> {
    with_node(&args.network, "calibrate", async |node: &Node| {
        let mut found = FoundImages::default();
        let shutdown = Shutdown::on_signals()?;
        let frames = node.frame_subscriber(topic::FRAME, &[camera]).await?;
        let mut converter = Converter::default();
        let mut said = None;
        write_error("Show the board to the camera; Ctrl-C when it is enough.");
        loop {
            let next = tokio::select! {
                next = tokio::time::timeout(FRAME_TIMEOUT, frames.next()) => next,
                () = shutdown.requested() => break,
            };
            let Ok(next) = next else {
                ensure!(
                    found.images > 0,
                    "no frame of the camera {camera:?} within {} s: is camera-pub running? `alight doctor` checks it",
                    FRAME_TIMEOUT.as_secs()
                );
                write_error("The camera sends no more frames.");
                break;
            };
            let frame = next.context("the session is closed")?;
            let picture = picture(&frame, &mut converter)?;
            if let Some(sensor) = args.on_sensor() {
                let FrameHeader { width, height, .. } = frame.header;
                sensor.check([width, height])?;
            }
            found.add(finder, picture);
            if say(&found, args, &mut said)? || found.is_full {
                break;
            }
        }
        Ok(found)
    })
}

fn picture(frame: &Frame, converter: &mut Converter) -> anyhow::Result<Picture> {
    let FrameHeader { format, sequence, .. } = frame.header;
    ensure!(
        format.sample_format().is_some(),
        "frames of {format:?} cannot be calibrated with: use the camera's own ones"
    );
    let image = grey(frame, converter)?;
    Ok(Picture { name: format!("frame {sequence}"), image, origin: Origin::Live })
}

/// Shows which views are missing, when that has changed. Returns whether none is missing.
fn say(found: &FoundImages, args: &BoardArgs, said: &mut Option<Shown>) -> anyhow::Result<bool> {
    let views = found.views.len();
    if said.as_ref().is_some_and(|before| before.views == views) {
        return Ok(false);
    }
    let first = views
        .is_multiple_of(VIEWS_PER_SOLUTION)
        .then(|| calibrate_unjudged(&found.views, args.lens.model(), &args.options()).ok())
        .flatten();
    let mut shown = Shown::new(found, first.as_ref());
    let is_enough = first.is_some() && shown.next.is_empty();
    if let (None, Some(before)) = (&first, said.as_ref()) {
        (shown.tilt_deg, shown.distance_ratio) = (before.tilt_deg, before.distance_ratio);
        shown.next = shown.advice();
    }
    match args.format {
        Format::Text => write_error(&shown.line()),
        Format::Json => print(&serde_json::json!({ "shown": shown.json() }).to_string())?,
    }
    *said = Some(shown);
    Ok(is_enough)
}
