//! Compares the losses of a stream of H.264 with those of a real encoder and a real decoder for the same pictures.
#![allow(
    clippy::unwrap_used,
    clippy::print_stdout,
    reason = "a test may stop anywhere, and prints its measurements"
)]

use std::io::Write;
use std::process::{Command, Stdio};

use geometry::{Body, CameraModel, Ned, Point, Rotation, Transform};
use rendering::processing::Video;
use rendering::{CameraSettings, PadInScene, Preset, Processing, Renderer, Scene, Surface};

const SIZE: [usize; 2] = [640, 480];
const KEY_FRAME_EVERY: usize = 8;
const PICTURES: usize = 20;

/// Pictures of a camera that comes down past a marker.
fn pictures(surface: Surface, processing: Processing) -> Vec<Vec<u8>> {
    let pad = PadInScene::flat("apriltag-36h11:7:0.3".parse().unwrap(), 0.1, -0.2, 0.3);
    let scene = Scene { surface, pads: vec![pad], painted_marks: 20, light: 1.0 };
    let model = CameraModel::pinhole(SIZE[0] as u32, SIZE[1] as u32, 600.0);
    let settings = CameraSettings { model, processing, ..CameraSettings::thesis() };
    let mut renderer = Renderer::new(&scene, settings, 5).unwrap();
    (0..PICTURES)
        .map(|index| {
            let t = index as f64 / 30.0;
            let level =
                Rotation::<Ned, Body>::from_euler(0.02 * (3.0 * t).sin(), 0.03, 0.4 + 0.2 * t);
            let place = Point::<Ned>::new(0.3 * t, -0.2 * t, -4.0 + 1.5 * t);
            let mut pixels = vec![0; SIZE[0] * SIZE[1]];
            renderer.render(&[Transform::new(level, place)], index as u64, &mut pixels).unwrap();
            pixels
        })
        .collect()
}

/// The output of ffmpeg for its standard input.
fn ffmpeg(arguments: &str, input: Vec<u8>) -> Vec<u8> {
    let mut child = Command::new("ffmpeg")
        .args(["-nostdin", "-loglevel", "error"])
        .args(arguments.split(' '))
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut pipe = child.stdin.take().unwrap();
    let writer = std::thread::spawn(move || pipe.write_all(&input));
    let output = child.wait_with_output().unwrap();
    writer.join().unwrap().unwrap();
    assert!(output.status.success(), "{arguments}");
    output.stdout
}

/// The pictures through x264 and ffmpeg's decoder.
fn through_x264(pictures: &[Vec<u8>], quantiser: u8) -> Vec<Vec<u8>> {
    let [width, height] = SIZE;
    let raw = format!("-f rawvideo -pix_fmt gray -s {width}x{height}");
    let full = "-vf scale=in_range=full:out_range=full";
    let coding = format!(
        "-c:v libx264 -preset veryfast -tune zerolatency -profile:v main -bf 0 -g {KEY_FRAME_EVERY} -sc_threshold 0 -qp {quantiser}"
    );
    let stream = ffmpeg(
        &format!("-r 30 {raw} -i - {full},format=yuv420p -color_range pc {coding} -f h264 -"),
        pictures.concat(),
    );
    let shown = ffmpeg(&format!("-f h264 -i - {full},format=gray -f rawvideo -"), stream);
    shown.chunks_exact(width * height).map(<[u8]>::to_vec).collect()
}

/// Root mean square of the difference of two pictures.
fn rms(a: &[u8], b: &[u8]) -> f64 {
    let squares = a.iter().zip(b).map(|(a, b)| f64::from(a.abs_diff(*b)).powi(2));
    (squares.sum::<f64>() / a.len() as f64).sqrt()
}

/// The mean over the pictures whose number since the last key frame is among these.
fn mean(values: &[f64], since: std::ops::Range<usize>) -> f64 {
    let (mut sum, mut count) = (0.0, 0.0);
    for (index, value) in values.iter().enumerate() {
        if since.contains(&(index % KEY_FRAME_EVERY)) {
            (sum, count) = (sum + value, count + 1.0);
        }
    }
    sum / count
}

#[test]
fn about_as_much_is_lost_and_stays_as_in_x264() {
    if !testing::has_x264() {
        return;
    }
    for (surface, quantiser) in [(Surface::Grass, 25), (Surface::Asphalt, 31), (Surface::Tiles, 37)]
    {
        let plain = Processing { jpeg_quality: None, ..Preset::Usb.processing() };
        let video = Some(Video { quantiser, key_frame_every: KEY_FRAME_EVERY as u16 });
        let shown = pictures(surface, plain);
        let real = through_x264(&shown, quantiser);
        let own = pictures(surface, Processing { video, ..plain });
        assert_eq!(real.len(), own.len());
        let lost = |left: &[Vec<u8>]| -> Vec<f64> {
            shown.iter().zip(left).map(|(shown, left)| rms(shown, left)).collect()
        };
        let still = |left: &[Vec<u8>]| -> Vec<f64> {
            let same = |[a, b]: [&Vec<u8>; 2]| a.iter().zip(b).filter(|(a, b)| a == b).count();
            let share = |at: usize| match at {
                0 => 0.0,
                _ => same([&left[at - 1], &left[at]]) as f64 / (SIZE[0] * SIZE[1]) as f64,
            };
            (0..left.len()).map(share).collect()
        };
        let ([own_lost, real_lost], [own_still, real_still]) =
            ([lost(&own), lost(&real)], [still(&own), still(&real)]);
        for since in [0..1, 1..3, 5..8] {
            let [a, b] = [&own_lost, &real_lost].map(|lost| mean(lost, since.clone()));
            println!("{surface:?} {quantiser}, {since:?}: {a:.2} lost, {b:.2} by x264");
            assert!((0.8..1.2).contains(&(a / b)), "{surface:?} {quantiser} {since:?}: {a} {b}");
        }
        let [a, b] = [&own_still, &real_still].map(|still| mean(still, 1..8));
        println!("{surface:?} {quantiser}: {:.1} % stay, {:.1} % in x264", 100.0 * a, 100.0 * b);
        assert!((0.6..1.67).contains(&(a / b)), "{surface:?} {quantiser}: {a} {b}");
    }
}
