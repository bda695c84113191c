//! Recordings are written, cut, damaged, repaired and read again.

#![expect(clippy::unwrap_used, reason = "a test fails by a panic")]

use std::ops::Range;

use flightlog::channel::{RAW_PREFIX, Received, split_raw};
use flightlog::{About, Picture, Writer, repair};
use messages::{
    BayerPattern, DetectorState, ExposureReason, ExposureSetter, FrameHeader, LandedState,
    LensModel, PacketSignature, Phase, PixelFormat, Place, RefusedShape, SigningState, Wind,
    encode,
};

const MESSAGES: usize = 60;

fn wind(number: usize) -> Wind {
    Wind { velocity_ned_m_s: [number as f64, 0.0, 0.0], stamp_ns: number as i64 }
}

/// A recording with a chunk for every ten messages; without an end when `is_killed`.
fn recording(is_killed: bool) -> Vec<u8> {
    let mut bytes = Vec::new();
    let about = About { program: "alight".into(), ..About::default() };
    let mut writer = Writer::new(&mut bytes, &about).unwrap();
    for number in 0..MESSAGES {
        let payload = encode(&wind(number));
        let received_ns = number as i64;
        writer
            .receive(Received { key: "wind", payload: &payload, attachment: b"", received_ns })
            .unwrap();
        if number % 10 == 9 {
            writer.flush().unwrap();
        }
    }
    if is_killed {
        std::mem::forget(writer);
    } else {
        writer.finish().unwrap();
    }
    bytes
}

/// The numbers of the messages in a recording, as they came.
fn numbers(recording: &[u8]) -> Vec<usize> {
    let messages = mcap::MessageStream::new(recording).unwrap().map(Result::unwrap);
    let raw = messages.filter(|message| message.channel.topic.starts_with(RAW_PREFIX));
    raw.map(|message| {
        let (_, payload) = split_raw(&message.data).unwrap();
        messages::decode::<Wind>(payload).unwrap().stamp_ns as usize
    })
    .collect()
}

#[test]
fn pictures_of_another_kind_get_a_channel_of_their_own() {
    let mut bytes = Vec::new();
    let mut writer = Writer::new(&mut bytes, &About::default()).unwrap();
    // A camera that is started again, twice.
    for format in [PixelFormat::Jpeg, PixelFormat::Mono8, PixelFormat::Jpeg] {
        let header = FrameHeader { width: 4, height: 2, format, ..FrameHeader::sample() };
        let attachment = encode(&header);
        let message = Received {
            key: "camera/down/frame",
            payload: &[7; 8],
            attachment: &attachment,
            received_ns: 1,
        };
        writer.frame(message, &header, &Picture::Pixels).unwrap();
    }
    writer.finish().unwrap();
    let messages = mcap::MessageStream::new(&bytes).unwrap().map(Result::unwrap);
    let pictures = messages.filter(|it| it.channel.topic == "camera/down/picture");
    let schemas: Vec<String> =
        pictures.map(|it| it.channel.schema.as_ref().unwrap().name.clone()).collect();
    let [jpeg, raw] = ["foxglove.CompressedImage", "foxglove.RawImage"];
    assert_eq!(schemas, [jpeg, raw, jpeg]);
}

#[test]
fn flushed_messages_survive_a_kill_and_are_ended_by_a_repair() {
    let killed = recording(true);
    assert!(mcap::Summary::read(&killed).map_or(true, |summary| summary.is_none()));
    let mut repaired = Vec::new();
    let found = repair(&killed, &mut repaired).unwrap();
    assert_eq!(numbers(&repaired), (0..MESSAGES).collect::<Vec<_>>());
    assert_eq!(found.messages, 2 * MESSAGES as u64);
    assert!(found.damage[0].contains("not ended"), "{found:?}");
    // A second repair finds no other damage.
    let mut again = Vec::new();
    let found = repair(&repaired, &mut again).unwrap();
    assert_eq!((found.damage, found.earlier.len()), (Vec::<String>::new(), 1));
    assert_eq!(numbers(&again).len(), MESSAGES);
}

#[test]
fn a_repaired_copy_states_what_was_lost() {
    let complete = recording(false);
    let chunks = chunks(&complete);
    let mut damaged = complete.clone();
    // In messages of the second and third chunk; their lengths stay.
    for chunk in &chunks[1..3] {
        damaged[chunk.end - 4] ^= 1;
    }
    let read = |file: &[u8]| flightlog::read(file, |_| ()).unwrap();
    let of_damaged = read(&damaged);
    assert_eq!((of_damaged.lost.chunks, of_damaged.lost.of), (2, 6));
    assert_eq!(of_damaged.lost.gaps_ns.len(), 1);
    assert_eq!(of_damaged.lost.gaps_ns.first(), Some(&(9..30)));
    let mut copy = Vec::new();
    repair(&damaged, &mut copy).unwrap();
    let of_copy = read(&copy);
    assert!(of_copy.is_repaired && of_copy.is_ended && !of_damaged.is_repaired);
    assert_eq!(of_copy.lost, of_damaged.lost);
    assert_eq!(of_copy.damage.len(), 2, "{of_copy:?}");
    assert!(of_copy.damage[0].starts_with("before its repair: the chunk after 1 complete"));
    // The copy of a damaged copy states both.
    let at = copy.len() / 2;
    copy[at] ^= 1;
    let mut again = Vec::new();
    let found = repair(&copy, &mut again).unwrap();
    assert_eq!((found.damage.len(), found.earlier.len()), (1, 2), "{found:?}");
    let of_again = read(&again);
    assert_eq!((of_again.lost.chunks, of_again.lost.of, of_again.damage.len()), (3, 6, 3));
    // One that was cut off counts as such afterwards; one whose index alone is missing is complete again.
    for (length, is_ended) in [(chunks[4].end, false), (complete.len() - 60, true)] {
        let mut copy = Vec::new();
        repair(&complete[..length], &mut copy).unwrap();
        assert_eq!((read(&copy).is_ended, read(&copy).damage.len()), (is_ended, 0), "{length}");
    }
}

#[test]
fn a_full_disk_is_named_once() {
    struct Full;
    impl std::io::Write for Full {
        fn write(&mut self, _: &[u8]) -> std::io::Result<usize> {
            Err(std::io::Error::from_raw_os_error(28))
        }
        fn flush(&mut self) -> std::io::Result<()> {
            Ok(())
        }
    }
    let error = repair(&recording(true), Full).unwrap_err();
    let mut texts = vec![error.to_string()];
    let mut cause = std::error::Error::source(&error);
    while let Some(next) = cause {
        texts.push(next.to_string());
        cause = next.source();
    }
    assert_eq!(texts.len(), 1, "{texts:?}");
    assert!(texts[0].contains("No space left"), "{texts:?}");
}

#[test]
fn whatever_is_cut_the_whole_chunks_before_it_are_recovered() {
    let complete = recording(false);
    let chunks = chunks(&complete);
    assert_eq!(chunks.len(), MESSAGES / 10);
    for length in mcap::MAGIC.len()..complete.len() {
        let mut repaired = Vec::new();
        let found = repair(&complete[..length], &mut repaired).unwrap();
        let before = chunks.iter().filter(|chunk| chunk.end <= length).count();
        assert!(
            found.chunks as usize >= before,
            "{length}: {found:?}, {before} chunks are complete"
        );
        assert_eq!(numbers(&repaired).len(), 10 * found.chunks as usize, "{length}");
        assert!(!found.damage.is_empty(), "cut at {length} of {}", complete.len());
    }
    assert!(repair(&complete[..4], &mut Vec::new()).is_err());
}

#[test]
fn flipped_bits_are_named_and_lose_no_other_chunk() {
    let complete = recording(false);
    let chunks = chunks(&complete);
    let mut random = 1_u64;
    let mut named = 0;
    for _ in 0..10_000 {
        // Numerical Recipes' generator: any will do.
        random =
            random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        let bit = (random >> 16) as usize % (8 * complete.len());
        let mut damaged = complete.clone();
        damaged[bit / 8] ^= 1 << (bit % 8);
        let mut repaired = Vec::new();
        let Ok(found) = repair(&damaged, &mut repaired) else { continue };
        named += usize::from(!found.damage.is_empty());
        let before = chunks.iter().filter(|chunk| chunk.end <= bit / 8).count();
        // The length of a record is not repeated: all data after a damaged one are lost.
        let is_in_chunk = chunks.iter().any(|chunk| chunk.contains(&(bit / 8)));
        let min = if is_in_chunk { MESSAGES - 10 } else { 10 * before };
        assert!(numbers(&repaired).len() >= min, "bit {bit}: {found:?}");
    }
    assert!(named > 5000, "{named}");
}

/// Where the bytes of each chunk are.
fn chunks(recording: &[u8]) -> Vec<Range<usize>> {
    const CHUNK: u8 = 6;
    let mut chunks = Vec::new();
    let mut at = mcap::MAGIC.len();
    while let Some((opcode, rest)) = recording.get(at..).and_then(<[u8]>::split_first) {
        let Some((length, _)) = rest.split_first_chunk::<8>() else { break };
        let bytes = at + 9..at + 9 + u64::from_le_bytes(*length) as usize;
        at = bytes.end;
        if *opcode == CHUNK {
            chunks.push(bytes);
        }
    }
    chunks
}

#[test]
fn the_spellings_of_variants_in_json_are_those_of_the_documentation() {
    fn spelled<T: serde::Serialize>(values: &[T]) -> Vec<String> {
        values.iter().map(|value| serde_json::to_string(value).unwrap()).collect()
    }
    let formats = [
        PixelFormat::Mono8,
        PixelFormat::Jpeg,
        PixelFormat::Mono10,
        PixelFormat::Mono12,
        PixelFormat::Mono16,
        PixelFormat::Bayer8(BayerPattern::Rggb),
        PixelFormat::Bayer10(BayerPattern::Grbg),
        PixelFormat::Bayer12(BayerPattern::Gbrg),
        PixelFormat::Bayer16(BayerPattern::Bggr),
    ];
    let landed = [
        LandedState::Unknown,
        LandedState::OnGround,
        LandedState::TakingOff,
        LandedState::InAir,
        LandedState::Landing,
    ];
    let states = [
        DetectorState::Active,
        DetectorState::Shadow,
        DetectorState::Stale,
        DetectorState::Blind,
        DetectorState::Outvoted,
        DetectorState::NoPose,
    ];
    let setters = [ExposureSetter::Fixed, ExposureSetter::Camera, ExposureSetter::Marker];
    let reasons = [
        ExposureReason::Configured,
        ExposureReason::NoMarker,
        ExposureReason::LostSoon,
        ExposureReason::TakenOver,
        ExposureReason::Settling,
        ExposureReason::NotInFrame,
        ExposureReason::NoContrast,
        ExposureReason::Good,
        ExposureReason::Clipped,
        ExposureReason::TooBright,
        ExposureReason::TooDark,
        ExposureReason::MotionBlur,
        ExposureReason::LessNoise,
        ExposureReason::AtLimits,
    ];
    let signatures =
        [PacketSignature::Unsigned, PacketSignature::Unchecked, PacketSignature::Verified];
    let signing =
        [SigningState::Off, SigningState::NoKey, SigningState::Wanted, SigningState::InForce];
    let phases = [
        Phase::Idle,
        Phase::Takeoff,
        Phase::Search,
        Phase::Approach,
        Phase::Descend,
        Phase::Retry,
        Phase::Final,
        Phase::Landed,
        Phase::Hold,
        Phase::Aborted,
        Phase::PilotInCommand,
        Phase::Failed,
    ];
    let documented = include_str!("../../../docs/wire-format.md");
    let (_, documented) = documented.split_once("## As JSON").unwrap();
    for (row, spelled) in [
        ("`format` of", spelled(&formats)),
        ("`set_by` of", spelled(&setters)),
        ("`why` of", spelled(&reasons)),
        ("`place` of", spelled(&[Place::Onboard, Place::Ground])),
        ("`phase` of", spelled(&phases)),
        ("`state` of", spelled(&states)),
        ("`landed` of", spelled(&landed)),
        ("`signature` of", spelled(&signatures)),
        ("`signing.state` of", spelled(&signing)),
    ] {
        let start = format!("| {row}");
        let line = documented.lines().find(|line| line.starts_with(&start)).unwrap();
        let expected: Vec<String> = spelled.iter().map(|it| format!("`{it}`")).collect();
        assert!(line.contains(&format!("| {} |", expected.join(", "))), "{line}: {expected:?}");
    }
    for (value, start) in [
        (spelled(&[LensModel::Pinhole]), "\"Pinhole\""),
        (spelled(&[LensModel::BrownConrady([0.0; 8])]), "{\"BrownConrady\":["),
        (spelled(&[LensModel::KannalaBrandt([0.0; 4])]), "{\"KannalaBrandt\":["),
        (spelled(&[RefusedShape::Quad([[0.0; 2]; 4])]), "{\"Quad\":["),
    ] {
        assert!(value[0].starts_with(start) && documented.contains(start), "{value:?}");
    }
}
