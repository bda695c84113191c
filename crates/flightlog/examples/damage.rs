//! Cuts a recording of a megabyte at every byte, and flips bits in it: complete chunks before the damage are recovered, and the
//! damage is named.
//!
//! `cargo run --release -p flightlog --example damage [EVERY [FLIPS]]`: cuts at every so many bytes (1), so many flips
//! (10000).

#![expect(clippy::print_stdout, reason = "measurements are for people to read")]

use std::time::Instant;

use flightlog::{About, Picture, Received, Writer, repair};
use messages::{Detections, FrameHeader, encode, topic};

const FRAMES: i64 = 15;
/// Bytes of a picture.
const PICTURE_BYTES: usize = 65_000;

type Result<T> = std::result::Result<T, Box<dyn std::error::Error>>;

fn main() -> Result<()> {
    let mut arguments = std::env::args().skip(1).map(|text| text.parse::<usize>());
    let every = arguments.next().unwrap_or(Ok(1))?.max(1);
    let flips = arguments.next().unwrap_or(Ok(10_000))?;
    let complete = recording()?;
    let ends = chunk_ends(&complete);
    println!("{} bytes in {} chunks", complete.len(), ends.len());
    let began = Instant::now();
    let mut cuts = 0;
    for length in (mcap::MAGIC.len()..complete.len()).step_by(every) {
        let found = repair(&complete[..length], std::io::sink())?;
        let before = ends.iter().filter(|end| **end <= length).count() as u64;
        if found.chunks < before {
            return Err(format!("cut at {length}: {found:?}, {before} are complete").into());
        }
        cuts += 1;
    }
    println!(
        "{cuts} cuts: every complete chunk recovered ({:.0} s)",
        began.elapsed().as_secs_f64()
    );
    let began = Instant::now();
    let mut random = 1_u64;
    let (mut named, mut refused, mut unchanged) = (0, 0, 0);
    let mut first = Vec::new();
    let all = repair(&complete, &mut first)?;
    for _ in 0..flips {
        // Numerical Recipes' generator: any will do.
        random =
            random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        let bit = (random >> 16) as usize % (8 * complete.len());
        let mut damaged = complete.clone();
        damaged[bit / 8] ^= 1 << (bit % 8);
        let mut copy = Vec::new();
        let Ok(found) = repair(&damaged, &mut copy) else {
            refused += 1;
            continue;
        };
        if !found.damage.is_empty() {
            named += 1;
        } else if found == all && copy == first {
            unchanged += 1;
        } else {
            return Err(format!("bit {bit}: {found:?} is not named, and {all:?} was there").into());
        }
        let before = ends.iter().filter(|end| **end <= bit / 8).count() as u64;
        if found.chunks < before {
            return Err(format!("bit {bit}: {found:?}, {before} are complete").into());
        }
    }
    println!(
        "{flips} flips: every chunk before them recovered; {named} named, {refused} in the magic bytes, {unchanged} not named \
         and the copy the same byte by byte ({:.0} s)",
        began.elapsed().as_secs_f64()
    );
    Ok(())
}

/// Frames and their detections, a chunk for every three.
fn recording() -> Result<Vec<u8>> {
    let mut bytes = Vec::new();
    let mut writer = Writer::new(&mut bytes, &About::default())?;
    for number in 0..FRAMES {
        let header =
            FrameHeader { sequence: number as u64, stamp_ns: number, ..FrameHeader::sample() };
        let attachment = encode(&header);
        let key = topic::FRAME.key(&[&header.camera]);
        let frame =
            Received { key: &key, payload: b"", attachment: &attachment, received_ns: number };
        let picture: Vec<u8> =
            (0..PICTURE_BYTES).map(|at| (at * 7 + number as usize) as u8).collect();
        writer.frame(frame, &header, &Picture::Jpeg(picture))?;
        let payload = encode(&Detections { header, ..Detections::sample() });
        let key = topic::DETECTIONS.key(&["main"]);
        writer.receive(Received {
            key: &key,
            payload: &payload,
            attachment: b"",
            received_ns: number,
        })?;
        if number % 3 == 2 {
            writer.flush()?;
        }
    }
    writer.finish()?;
    Ok(bytes)
}

/// Where each chunk ends.
fn chunk_ends(recording: &[u8]) -> Vec<usize> {
    const CHUNK: u8 = 6;
    let mut ends = Vec::new();
    let mut at = mcap::MAGIC.len();
    while let Some((opcode, rest)) = recording.get(at..).and_then(<[u8]>::split_first) {
        let Some((length, _)) = rest.split_first_chunk::<8>() else { break };
        at += 9 + u64::from_le_bytes(*length) as usize;
        if *opcode == CHUNK {
            ends.push(at);
        }
    }
    ends
}
