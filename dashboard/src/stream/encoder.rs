//! Encodes grey images as H.264, with OpenH264.

use imaging::GrayImage;
use openh264::OpenH264API;
use openh264::encoder::{
    BitRate, Complexity, EncoderConfig, FrameRate, RateControlMode, UsageType, VuiConfig,
};
use openh264::formats::YUVSlices;

/// Period of key pictures, in nanoseconds: a receiver that starts, or has lost a packet, waits for the next one.
const KEY_PERIOD_NS: i64 = 1_000_000_000;
/// Value of both chroma planes of a grey image.
const NO_COLOUR: u8 = 128;

/// Encodes images one after the other; starts again when their size changes.
pub(super) struct Encoder {
    kbit_s: u32,
    rate_hz: f64,
    /// The encoder, with the size that it is for.
    running: Option<Running>,
    chroma: Vec<u8>,
}

struct Running {
    encoder: openh264::encoder::Encoder,
    size: [usize; 2],
    /// When the last key picture was made.
    key_ns: Option<i64>,
}

impl Encoder {
    pub(super) fn new(kbit_s: u32, rate_hz: f64) -> Self {
        Self { kbit_s, rate_hz, running: None, chroma: Vec::new() }
    }

    /// The units (NAL units, without start codes) of an image, none of one that is left out to keep the rate; an odd last row
    /// or column is left out.
    ///
    /// # Errors
    /// The encoder's error, also for a size that it does not support.
    pub(super) fn encode(
        &mut self,
        image: &GrayImage,
        now_ns: i64,
    ) -> Result<Vec<Vec<u8>>, String> {
        let size = [image.width() & !1, image.height() & !1];
        if size.contains(&0) {
            return Err(format!("an image of {} x {} pixels", image.width(), image.height()));
        }
        if self.running.as_ref().is_none_or(|running| running.size != size) {
            self.running = Some(self.start(size)?);
            self.chroma = vec![NO_COLOUR; size[0] / 2 * (size[1] / 2)];
        }
        let Some(running) = &mut self.running else { return Ok(Vec::new()) };
        if running.key_ns.is_none_or(|key_ns| now_ns - key_ns >= KEY_PERIOD_NS) {
            running.encoder.force_intra_frame();
            running.key_ns = Some(now_ns);
        }
        let luma = image.pixels().get(..image.width() * size[1]).unwrap_or_default();
        let planes = (luma, self.chroma.as_slice(), self.chroma.as_slice());
        let strides = (image.width(), size[0] / 2, size[0] / 2);
        let source = YUVSlices::new(planes, (size[0], size[1]), strides);
        let encoded = running.encoder.encode(&source).map_err(|error| error.to_string())?;
        let mut units = Vec::new();
        for layer in (0..encoded.num_layers()).filter_map(|at| encoded.layer(at)) {
            let encoded = (0..layer.nal_count()).filter_map(|at| layer.nal_unit(at));
            units.extend(encoded.map(|unit| without_start_code(unit).to_vec()));
        }
        Ok(units)
    }

    fn start(&self, size: [usize; 2]) -> Result<Running, String> {
        let config = EncoderConfig::new()
            .bitrate(BitRate::from_bps(self.kbit_s.saturating_mul(1000)))
            .max_frame_rate(FrameRate::from_hz(self.rate_hz as f32))
            .rate_control_mode(RateControlMode::Bitrate)
            .usage_type(UsageType::CameraVideoRealTime)
            .complexity(Complexity::Low)
            // Without this setting it does not keep the rate.
            .skip_frames(true)
            .vui(VuiConfig::bt709_full());
        let api = OpenH264API::from_source();
        let encoder = openh264::encoder::Encoder::with_api_config(api, config)
            .map_err(|error| error.to_string())?;
        Ok(Running { encoder, size, key_ns: None })
    }
}

fn without_start_code(unit: &[u8]) -> &[u8] {
    unit.strip_prefix(&[0, 0, 0, 1]).or_else(|| unit.strip_prefix(&[0, 0, 1])).unwrap_or(unit)
}
