//! Simulates a camera: an RTSP server with a script, which streams pictures of its own over TCP, or those that ffmpeg
//! pushes to it.
//!
//! Its H.264 has uncompressed macroblocks (I_PCM, 7.3.5 of the standard) and skipped ones, so that every pixel is known.

use std::fmt::Write;
use std::io::Cursor;
use std::sync::Arc;
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use jpeg_encoder::{ColorType, Encoder, SamplingFactor};
use node::now_ns;
use tokio::io::{AsyncBufReadExt, AsyncReadExt, AsyncWriteExt, BufReader};
use tokio::net::tcp::OwnedWriteHalf;
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::broadcast;
use tokio::task::JoinHandle;

pub(super) const WIDTH: usize = 64;
pub(super) const HEIGHT: usize = 48;
const BLOCKS: u64 = (WIDTH / 16 * HEIGHT / 16) as u64;
pub(super) const PERIOD: Duration = Duration::from_millis(20);
/// From when a picture is taken until it is sent.
pub(super) const DELAY_NS: i64 = 30_000_000;
/// Every so many pictures one is a key frame.
const KEY_EVERY: u64 = 10;
/// `user:password`, and the same in Base64.
pub(super) const CREDENTIALS: [&str; 2] = ["alight:s3cret", "YWxpZ2h0OnMzY3JldA=="];

/// The coding of the stream.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub(super) enum Streamed {
    H264,
    Jpeg,
    /// A coding that is not read.
    H265,
    /// The stream that is pushed to it.
    Pushed,
}

/// How the camera behaves.
#[derive(Clone, Debug)]
pub(super) struct Script {
    pub(super) streamed: Streamed,
    pub(super) wants_credentials: bool,
    /// How far its clock is ahead, in nanoseconds; `None` where it does not send its clock.
    pub(super) clock_ahead_ns: Option<i64>,
    /// One of so many packets is lost; 0: none.
    pub(super) lose_every: u64,
    /// The number of the picture after which it sends nothing more, and that after which it closes.
    pub(super) silent_after: u64,
    pub(super) closes_after: u64,
    /// The numbers of the pictures that are twice as wide.
    pub(super) wide: std::ops::Range<u64>,
}

impl Script {
    pub(super) fn of(streamed: Streamed) -> Self {
        Self {
            streamed,
            wants_credentials: false,
            clock_ahead_ns: None,
            lose_every: 0,
            silent_after: u64::MAX,
            closes_after: u64::MAX,
            wide: 0..0,
        }
    }
}

/// The camera.
pub(super) struct Camera {
    shared: Arc<Shared>,
    port: u16,
    accepting: JoinHandle<()>,
}

struct Shared {
    script: Script,
    /// Number of the next picture, of all connections.
    next: AtomicU64,
    /// When each picture was taken, in nanoseconds of the host's clock.
    taken: Mutex<Vec<i64>>,
    is_off: AtomicBool,
    /// The description and the packets that are pushed.
    pushed: Mutex<Option<String>>,
    packets: broadcast::Sender<Vec<u8>>,
    /// Requests that came, without their headers.
    requests: Mutex<Vec<String>>,
}

impl Camera {
    pub(super) async fn play(script: Script) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let port = listener.local_addr().unwrap().port();
        let shared = Arc::new(Shared {
            script,
            next: AtomicU64::new(0),
            taken: Mutex::new(Vec::new()),
            is_off: AtomicBool::new(false),
            pushed: Mutex::new(None),
            packets: broadcast::channel(4096).0,
            requests: Mutex::new(Vec::new()),
        });
        let accepting = tokio::spawn(accept(Arc::clone(&shared), listener));
        Self { shared, port, accepting }
    }

    pub(super) fn url(&self) -> String {
        format!("rtsp://127.0.0.1:{}/main", self.port)
    }

    /// When the picture was taken.
    pub(super) fn taken_ns(&self, number: u64) -> i64 {
        self.shared.taken.lock().unwrap()[number as usize]
    }

    /// Unplugs the camera, or plugs it in again: connections are refused meanwhile.
    pub(super) fn switch(&self, is_off: bool) {
        self.shared.is_off.store(is_off, Ordering::SeqCst);
    }

    pub(super) fn has_been_pushed_to(&self) -> bool {
        self.shared.pushed.lock().unwrap().is_some()
    }

    pub(super) fn requests(&self) -> Vec<String> {
        self.shared.requests.lock().unwrap().clone()
    }
}

impl Drop for Camera {
    fn drop(&mut self) {
        self.accepting.abort();
    }
}

async fn accept(shared: Arc<Shared>, listener: TcpListener) {
    while let Ok((stream, _)) = listener.accept().await {
        let shared = Arc::clone(&shared);
        // A client that is gone needs no answer.
        tokio::spawn(async move { serve(&shared, stream).await.unwrap_or_default() });
    }
}

/// One connection.
async fn serve(shared: &Arc<Shared>, stream: TcpStream) -> std::io::Result<()> {
    stream.set_nodelay(true)?;
    let (read, mut write) = stream.into_split();
    let mut read = BufReader::new(read);
    loop {
        if shared.is_off.load(Ordering::SeqCst) {
            return Ok(());
        }
        let mut first = [0];
        read.read_exact(&mut first).await?;
        if first == *b"$" {
            let mut head = [0; 3];
            read.read_exact(&mut head).await?;
            let mut packet = vec![0; usize::from(u16::from_be_bytes([head[1], head[2]]))];
            read.read_exact(&mut packet).await?;
            // Of a player these are its own reports.
            let whole = [&b"$"[..], &head, &packet].concat();
            drop(shared.packets.send(whole));
            continue;
        }
        let mut request = String::from(char::from(first[0]));
        while !request.ends_with("\r\n\r\n") {
            if read.read_line(&mut request).await? == 0 {
                return Ok(());
            }
        }
        let header = |name: &str| {
            let lines = request.lines().filter_map(|line| line.split_once(": "));
            lines.into_iter().find(|(key, _)| key.eq_ignore_ascii_case(name)).map(|(_, v)| v)
        };
        let length = header("Content-Length").and_then(|length| length.parse().ok()).unwrap_or(0);
        let mut body = vec![0; length];
        read.read_exact(&mut body).await?;
        let method = request.split(' ').next().unwrap_or_default();
        shared.requests.lock().unwrap().push(method.to_owned());
        let mut answer = "RTSP/1.0 200 OK\r\n".to_owned();
        let mut body_text = String::new();
        let is_allowed = !shared.script.wants_credentials
            || header("Authorization") == Some(&format!("Basic {}", CREDENTIALS[1]));
        match method {
            _ if !is_allowed => {
                answer =
                    "RTSP/1.0 401 Unauthorized\r\nWWW-Authenticate: Basic realm=\"camera\"\r\n"
                        .to_owned();
            }
            "OPTIONS" => {
                answer.push_str("Public: DESCRIBE, SETUP, PLAY, ANNOUNCE, RECORD, TEARDOWN\r\n");
            }
            "ANNOUNCE" => *shared.pushed.lock().unwrap() = String::from_utf8(body).ok(),
            "DESCRIBE" => {
                body_text = description(shared);
                answer.push_str("Content-Type: application/sdp\r\n");
            }
            "SETUP" => {
                let transport = header("Transport").unwrap_or_default();
                let source =
                    if shared.script.streamed == Streamed::Pushed { "" } else { ";ssrc=00000007" };
                write!(answer, "Session: 7;timeout=60\r\nTransport: {transport}{source}\r\n")
                    .unwrap();
            }
            _ => answer.push_str("Session: 7\r\n"),
        }
        let sequence = header("CSeq").unwrap_or_default();
        write!(
            answer,
            "CSeq: {sequence}\r\nContent-Length: {}\r\n\r\n{body_text}",
            body_text.len()
        )
        .unwrap();
        write.write_all(answer.as_bytes()).await?;
        if method == "PLAY" && is_allowed {
            return play(shared, write).await;
        }
    }
}

fn description(shared: &Shared) -> String {
    let head = "v=0\r\no=- 0 0 IN IP4 127.0.0.1\r\ns=camera\r\nt=0 0\r\nm=audio 0 RTP/AVP 0\r\na=control:sound\r\n";
    let video = match shared.script.streamed {
        Streamed::H264 => "m=video 0 RTP/AVP 96\r\na=rtpmap:96 H264/90000\r\na=control:video\r\n",
        Streamed::Jpeg => "m=video 0 RTP/AVP 26\r\na=rtpmap:26 JPEG/90000\r\na=control:video\r\n",
        Streamed::H265 => "m=video 0 RTP/AVP 97\r\na=rtpmap:97 H265/90000\r\na=control:video\r\n",
        Streamed::Pushed => return shared.pushed.lock().unwrap().clone().unwrap_or_default(),
    };
    format!("{head}{video}")
}

/// Streams until the script or the player ends it.
async fn play(shared: &Shared, mut write: OwnedWriteHalf) -> std::io::Result<()> {
    if shared.script.streamed == Streamed::Pushed {
        let mut packets = shared.packets.subscribe();
        while let Ok(packet) = packets.recv().await {
            write.write_all(&packet).await?;
        }
        return Ok(());
    }
    let mut ticks = tokio::time::interval(PERIOD);
    let mut rtp = Rtp { sequence: 40_000, packets: 0 };
    loop {
        ticks.tick().await;
        if shared.is_off.load(Ordering::SeqCst) {
            return Ok(());
        }
        let number = shared.next.fetch_add(1, Ordering::SeqCst);
        let taken_ns = now_ns() - DELAY_NS;
        shared.taken.lock().unwrap().push(taken_ns);
        if number == shared.script.silent_after {
            std::future::pending::<()>().await;
        }
        if number == shared.script.closes_after {
            return Ok(());
        }
        // 90 kHz, and a start that no two connections share.
        let stamp = (taken_ns * 9 / 100_000) as u32;
        if let Some(ahead_ns) = shared.script.clock_ahead_ns.filter(|_| number % 25 == 5) {
            write.write_all(&sender_report(stamp, taken_ns, ahead_ns)).await?;
        }
        let width = WIDTH * if shared.script.wide.contains(&number) { 2 } else { 1 };
        let payloads = match shared.script.streamed {
            Streamed::Jpeg => jpeg_payloads(number, width),
            _ => h264_payloads(number, width, &shared.script.wide),
        };
        let count = payloads.len();
        for (i, payload) in payloads.into_iter().enumerate() {
            let packet = rtp.packet(stamp, i + 1 == count, shared.script.streamed, &payload);
            let every = shared.script.lose_every;
            if every == 0 || rtp.packets % every != every - 1 {
                write.write_all(&packet).await?;
            }
        }
    }
}

struct Rtp {
    sequence: u16,
    packets: u64,
}

impl Rtp {
    /// A packet, interleaved between answers (RFC 2326, 10.12; RFC 3550, 5.1).
    fn packet(&mut self, stamp: u32, is_last: bool, streamed: Streamed, payload: &[u8]) -> Vec<u8> {
        let kind = if streamed == Streamed::Jpeg { 26 } else { 96 };
        let mark = if is_last { 0x80 } else { 0 };
        self.sequence = self.sequence.wrapping_add(1);
        self.packets += 1;
        let mut packet = vec![b'$', 0];
        packet.extend(((payload.len() + 12) as u16).to_be_bytes());
        packet.extend([0x80, mark | kind]);
        packet.extend(self.sequence.to_be_bytes());
        packet.extend(stamp.to_be_bytes());
        packet.extend(7u32.to_be_bytes());
        packet.extend(payload);
        packet
    }
}

/// The camera's clock at the time of a picture (RFC 3550, 6.4.1).
fn sender_report(stamp: u32, taken_ns: i64, ahead_ns: i64) -> Vec<u8> {
    let utc_ns = SystemTime::now().duration_since(UNIX_EPOCH).unwrap().as_nanos() as i64;
    let camera_ns = utc_ns - now_ns() + taken_ns + ahead_ns;
    let since_1900 = ((i128::from(camera_ns) << 32) / 1_000_000_000) as u64 + (2_208_988_800 << 32);
    let mut packet = vec![b'$', 1, 0, 28, 0x80, 200, 0, 6];
    packet.extend(7u32.to_be_bytes());
    packet.extend(since_1900.to_be_bytes());
    packet.extend(stamp.to_be_bytes());
    packet.extend([0; 8]);
    packet
}

/// The level of a macroblock in a picture: that of the last picture which set it. Key frames set all, others one in turn.
pub(super) fn level(number: u64, block: u64) -> u8 {
    let key = number - number % KEY_EVERY;
    let by = (key..=number).rev().find(|by| *by == key || by % BLOCKS == block);
    // Never two zeros after each other in a row, which would need escapes.
    (by.unwrap_or_default() * 7 % 200 + 20) as u8
}

/// The level of the left columns of a JPEG file.
pub(super) fn jpeg_level(number: u64) -> u8 {
    (number % 100 * 2 + 20) as u8
}

fn h264_payloads(number: u64, width: usize, wide: &std::ops::Range<u64>) -> Vec<Vec<u8>> {
    // A change of the size begins with a key frame.
    let is_key = number.is_multiple_of(KEY_EVERY) || number == wide.start || number == wide.end;
    if is_key {
        let slice = slice(number, width, true);
        return vec![parameters(width), picture_parameters(), slice.clone()]
            .into_iter()
            .flat_map(|unit| fragments(&unit))
            .collect();
    }
    fragments(&slice(number, width, false))
}

/// A unit in packets of which none is large (RFC 6184, 5.8).
fn fragments(unit: &[u8]) -> Vec<Vec<u8>> {
    const MAX: usize = 1200;
    if unit.len() <= MAX {
        return vec![unit.to_vec()];
    }
    let (head, body) = (unit[0], &unit[1..]);
    let count = body.len().div_ceil(MAX);
    body.chunks(MAX)
        .enumerate()
        .map(|(i, part)| {
            let begin = if i == 0 { 0x80 } else { 0 };
            let end = if i + 1 == count { 0x40 } else { 0 };
            [&[head & 0x60 | 28, begin | end | head & 0x1f][..], part].concat()
        })
        .collect()
}

/// Bits as H.264 has them.
#[derive(Default)]
struct Bits {
    bytes: Vec<u8>,
    used: u32,
}

impl Bits {
    fn put(&mut self, value: u64, count: u32) -> &mut Self {
        for bit in (0..count).rev() {
            if self.used.is_multiple_of(8) {
                self.bytes.push(0);
            }
            let last = self.bytes.last_mut().unwrap();
            *last |= ((value >> bit & 1) as u8) << (7 - self.used % 8);
            self.used += 1;
        }
        self
    }

    /// ue(v) of 9.1.
    fn golomb(&mut self, value: u64) -> &mut Self {
        let length = 63 - (value + 1).leading_zeros();
        self.put(0, length).put(value + 1, length + 1)
    }

    fn align(&mut self, with: u64) -> &mut Self {
        while !self.used.is_multiple_of(8) {
            self.put(with, 1);
        }
        self
    }

    /// The unit, with the bytes that keep start codes out of it.
    fn unit(&mut self, head: u8) -> Vec<u8> {
        self.put(1, 1).align(0);
        let mut unit = vec![head];
        for byte in &self.bytes {
            if *byte < 4 && unit.ends_with(&[0, 0]) {
                unit.push(3);
            }
            unit.push(*byte);
        }
        unit
    }
}

/// 7.3.2.1: Baseline, one reference, the order of the stream.
fn parameters(width: usize) -> Vec<u8> {
    let mut bits = Bits::default();
    bits.put(66, 8).put(0xc0, 8).put(20, 8).golomb(0);
    bits.golomb(4).golomb(2).golomb(1).put(0, 1);
    bits.golomb(width as u64 / 16 - 1).golomb(HEIGHT as u64 / 16 - 1).put(0b11, 2);
    bits.put(0, 1).put(0, 1).unit(0x67)
}

/// 7.3.2.2: no entropy but CAVLC, no deblocking unless a slice requests it.
fn picture_parameters() -> Vec<u8> {
    let mut bits = Bits::default();
    bits.golomb(0).golomb(0).put(0, 2).golomb(0).golomb(0).golomb(0);
    bits.put(0, 3).golomb(0).golomb(0).golomb(0).put(0b100, 3).unit(0x68)
}

fn slice(number: u64, width: usize, is_key: bool) -> Vec<u8> {
    let count = (width / 16 * HEIGHT / 16) as u64;
    let mut bits = Bits::default();
    // first_mb, I or P, parameters, frame_num of 8 bits since the key frame.
    bits.golomb(0).golomb(if is_key { 7 } else { 5 }).golomb(0);
    bits.put(if is_key { 0 } else { number % KEY_EVERY }, 8);
    if is_key {
        bits.golomb(number % 2).put(0, 2);
    } else {
        // One reference, in its order; no marking.
        bits.put(0, 1).put(0, 1).put(0, 1);
    }
    // slice_qp_delta, deblocking off.
    bits.golomb(0).golomb(1);
    if is_key {
        for block in 0..count {
            macroblock(&mut bits, 25, level(number, block % BLOCKS));
        }
    } else {
        let block = number % BLOCKS;
        bits.golomb(block);
        macroblock(&mut bits, 30, level(number, block));
        if block + 1 < count {
            bits.golomb(count - block - 1);
        }
    }
    bits.unit(if is_key { 0x65 } else { 0x41 })
}

/// I_PCM of one level.
fn macroblock(bits: &mut Bits, kind: u64, level: u8) {
    bits.golomb(kind).align(0);
    for level in [level; 256].into_iter().chain([128; 128]) {
        bits.put(u64::from(level), 8);
    }
}

/// RFC 2435: a JPEG file of one level, with its own tables, in packets of which none is large.
fn jpeg_payloads(number: u64, width: usize) -> Vec<Vec<u8>> {
    let mut file = Cursor::new(Vec::new());
    let mut encoder = Encoder::new(&mut file, 80);
    encoder.set_sampling_factor(SamplingFactor::F_2_2);
    let pixels: Vec<u8> = (0..width * HEIGHT)
        .flat_map(|i| {
            let (x, y) = (i % width, i / width);
            [if x < 16 { jpeg_level(number) } else { ((x * 37 + y * 91) % 200) as u8 }; 3]
        })
        .collect();
    encoder.encode(&pixels, width as u16, HEIGHT as u16, ColorType::Rgb).unwrap();
    let file = file.into_inner();
    let (mut at, mut tables, mut scan) = (2, Vec::new(), 0);
    while scan == 0 {
        let length = usize::from(u16::from_be_bytes([file[at + 2], file[at + 3]]));
        match file[at + 1] {
            0xdb => {
                for table in file[at + 4..at + 2 + length].chunks_exact(65) {
                    tables.extend_from_slice(&table[1..]);
                }
            }
            0xda => scan = at + 2 + length,
            _ => {}
        }
        at += 2 + length;
    }
    let data = &file[scan..file.len() - 2];
    let chunks = data.chunks(500).scan(0, |offset, chunk| {
        let begin = *offset;
        *offset += chunk.len();
        Some((begin, chunk))
    });
    chunks
        .map(|(offset, chunk)| {
            let mut payload = (offset as u32).to_be_bytes().to_vec();
            payload.extend([1, 255, (width / 8) as u8, (HEIGHT / 8) as u8]);
            if offset == 0 {
                payload.extend([0, 0, 0, 128]);
                payload.extend_from_slice(&tables);
            }
            payload.extend_from_slice(chunk);
            payload
        })
        .collect()
}
