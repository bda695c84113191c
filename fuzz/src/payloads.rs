//! Reads messages of the network and bytes of the autopilot's link.

use airlink::Unpacker;
use autopilot::{Autopilot, Config, Parser};
use messages::{
    CameraControl, CameraInfo, CameraResponse, CommandReply, Configuration, ControllerCommand,
    ControllerStatus, Detections, DetectorCommand, DetectorInfo, FrameAck, FrameHeader, FramePart,
    GcsStatus, Health, MavlinkBytes, Message, PixelFormat, RecorderStatus, Refusals,
    TargetEstimate, Truth, VehicleState, Wind, decode, encode,
};

/// Edges of the frames that an air-link payload is read for, in pixels.
const MAX_EDGE_PX: u32 = 512;

/// A payload of any topic: read as each type. The value is written, and must be read again. Returns the types that could read
/// it.
pub fn codec(input: &[u8]) -> Vec<&'static str> {
    let read = [
        again::<FrameHeader>(input),
        again::<FrameAck>(input),
        again::<CameraInfo>(input),
        again::<CameraControl>(input),
        again::<Detections>(input),
        again::<Refusals>(input),
        again::<DetectorInfo>(input),
        again::<CameraResponse>(input),
        again::<DetectorCommand>(input),
        again::<TargetEstimate>(input),
        again::<ControllerStatus>(input),
        again::<ControllerCommand>(input),
        again::<CommandReply>(input),
        again::<VehicleState>(input),
        again::<MavlinkBytes>(input),
        again::<GcsStatus>(input),
        again::<Health>(input),
        again::<Configuration>(input),
        again::<RecorderStatus>(input),
        again::<Truth>(input),
        again::<Wind>(input),
    ];
    if let Ok(info) = decode::<CameraInfo>(input) {
        let _ = info.body_from_camera.transform::<geometry::Body, geometry::Camera>();
        let _ = info.model();
    }
    read.into_iter().flatten().collect()
}

/// The name of the type, if it could be read.
fn again<M: Message>(input: &[u8]) -> Option<&'static str> {
    let message = decode::<M>(input).ok()?;
    let written = encode(&message);
    assert_eq!(decode::<M>(&written).map(|read| encode(&read)), Ok(written));
    Some(M::NAME)
}

/// Bytes of the autopilot's link: found as packets in pieces of any length, and handled by the client.
pub fn mavlink(input: &[u8]) {
    let Some((first, bytes)) = input.split_first() else { return };
    let mut parser = Parser::new();
    let mut client = Autopilot::new(Config::default());
    let mut now_ns: i64 = 1_000_000_000;
    let piece = usize::from(*first).max(1);
    for part in bytes.chunks(piece) {
        let mut packets = parser.push(part);
        if part.len() < piece {
            packets.extend(parser.finish());
        }
        for packet in packets {
            assert!(packet.raw.len() <= autopilot::packet::MAX_PACKET);
            client.handle(now_ns, &packet);
            while client.poll_event().is_some() {}
        }
        now_ns += 10_000_000;
        client.tick(now_ns);
        while client.poll_outgoing().is_some() {}
    }
}

/// A frame of the air link: its header lists the parts that are JPEG files, with their sizes.
pub fn airlink(input: &[u8]) {
    let Some((head, bytes)) = input.split_first_chunk::<4>() else { return };
    let [width, height, count, split] = *head;
    let edge = |byte: u8| (u32::from(byte) * 4).clamp(1, MAX_EDGE_PX);
    let (width, height) = (edge(width), edge(height));
    let first = bytes.len() * usize::from(split) / 256;
    let part = |bytes: usize, scale: u32| FramePart {
        x: 0,
        y: 0,
        width: width / scale,
        height: height / scale,
        scale,
        bytes: bytes as u32,
    };
    let parts = match count % 3 {
        0 => Vec::new(),
        1 => vec![part(bytes.len(), 1)],
        _ => vec![part(first, 1), part(bytes.len() - first, 4)],
    };
    let header = FrameHeader {
        camera: "main".to_owned(),
        sequence: 1,
        stamp_ns: 1,
        clock: "here".to_owned(),
        exposure_ns: 0,
        width,
        height,
        format: PixelFormat::Jpeg,
        parts,
    };
    if let Ok(images) = Unpacker::default().unpack(&header, bytes) {
        for (part, image) in images {
            assert_eq!(
                (image.width(), image.height()),
                (part.width as usize, part.height as usize)
            );
        }
    }
}
