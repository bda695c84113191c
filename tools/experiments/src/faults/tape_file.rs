//! Writes a recording with a controller's tape, as a recorder would.

use std::fs::File;
use std::io::BufWriter;
use std::path::Path;

use anyhow::Context;
use flightlog::{About, Received, Writer};
use messages::{Tape, encode, topic};

/// Writes the tapes of a flight into a recording; `command` is the one that repeats the flight.
///
/// # Errors
/// When the file cannot be written.
pub fn write(path: &Path, tapes: &[Tape], command: &str) -> anyhow::Result<()> {
    let file =
        path.parent().map_or(Ok(()), std::fs::create_dir_all).and_then(|()| File::create(path));
    let file = file.with_context(|| format!("writing {path:?}"))?;
    let about = About {
        program: controller::tape::program(),
        facts: [("command".to_owned(), command.to_owned())].into(),
        utc_offset_ns: 0,
    };
    let mut recording = Writer::new(BufWriter::new(file), &about)?;
    let key = topic::TAPE.key(&[]);
    for tape in tapes {
        let payload = encode(tape);
        let received_ns = tape.begun_ns;
        recording.receive(Received {
            key: &key,
            payload: &payload,
            attachment: b"",
            received_ns,
        })?;
    }
    recording.finish().with_context(|| format!("writing {path:?}"))
}
