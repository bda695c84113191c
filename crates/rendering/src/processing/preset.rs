//! Defines the processing of kinds of cameras, by name.

use std::fmt;
use std::str::FromStr;

use super::{Denoise, Lens, LocalTone, Processing, Sharpen, ToneCurve, Video};

/// A kind of camera.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Preset {
    /// No processing, as in a raw file.
    #[default]
    Linear,
    /// A USB camera in MJPEG.
    Usb,
    /// A camera module of the Raspberry Pi, frames uncompressed.
    RaspberryPi,
    /// A monochrome machine-vision camera.
    Industrial,
    /// An action camera's video.
    ActionCamera,
    /// A phone.
    Phone,
    /// A network camera or a gimbal that streams H.264.
    IpCamera,
}

impl Preset {
    /// Every preset.
    pub const ALL: [Self; 7] = [
        Self::Linear,
        Self::Usb,
        Self::RaspberryPi,
        Self::Industrial,
        Self::ActionCamera,
        Self::Phone,
        Self::IpCamera,
    ];

    /// Its name.
    pub fn name(self) -> &'static str {
        match self {
            Self::Linear => "linear",
            Self::Usb => "usb",
            Self::RaspberryPi => "raspberry-pi",
            Self::Industrial => "industrial",
            Self::ActionCamera => "action-camera",
            Self::Phone => "phone",
            Self::IpCamera => "ip-camera",
        }
    }

    /// Its processing.
    pub fn processing(self) -> Processing {
        match self {
            Self::Linear => Processing::LINEAR,
            // UVC cameras default to gamma 100 (no curve besides that of the video standard) and at sharpness 2
            // or 3 of 7; on pictures of real ones unsharp masks of up to 0.5 were measured.
            Self::Usb => Processing {
                lens: Lens { curvature_px: 0.8, fringe_px: 0.5, flare: 0.01 },
                mosaic: true,
                denoise: Denoise::Bilateral { sigma_px: 0.7, range_levels: 6.0 },
                tone: ToneCurve::Srgb,
                sharpen: Some(Sharpen { radius_px: 1.0, amount: 0.5, limit_levels: 255.0 }),
                jpeg_quality: Some(85),
                ..Processing::LINEAR
            },
            // The gamma curve of libcamera's tuning of the imx219 (`rpi.contrast` in
            // src/ipa/rpi/vc4/data/imx219.json) is that of this knee to within 0.03; `rpi.sharpen` limits its
            // halos.
            Self::RaspberryPi => Processing {
                lens: Lens { curvature_px: 0.8, fringe_px: 0.4, flare: 0.01 },
                mosaic: true,
                denoise: Denoise::Bilateral { sigma_px: 0.7, range_levels: 4.0 },
                tone: ToneCurve::Shoulder { knee: 0.25 },
                sharpen: Some(Sharpen { radius_px: 0.8, amount: 0.4, limit_levels: 32.0 }),
                ..Processing::LINEAR
            },
            // Gamma is on by default in some, with 1.25 (an exponent of 0.8); nothing else is.
            Self::Industrial => {
                Processing { tone: ToneCurve::Gamma { exponent: 1.25 }, ..Processing::LINEAR }
            }
            // Video of high contrast and strong sharpening at a high rate, whose compression is about this JPEG.
            Self::ActionCamera => Processing {
                lens: Lens { curvature_px: 1.0, fringe_px: 0.8, flare: 0.02 },
                mosaic: true,
                denoise: Denoise::Bilateral { sigma_px: 0.9, range_levels: 8.0 },
                local_tone: Some(LocalTone { strength: 0.2, max_gain: 2.0, neighbourhood: 0.15 }),
                tone: ToneCurve::Filmic,
                sharpen: Some(Sharpen { radius_px: 1.0, amount: 0.8, limit_levels: 64.0 }),
                jpeg_quality: Some(75),
                ..Processing::LINEAR
            },
            // A burst of exposures, merged, denoised and made even (Hasinoff et al., "Burst photography for
            // high dynamic range and low-light imaging on mobile cameras", 2016).
            Self::Phone => Processing {
                lens: Lens { curvature_px: 0.5, fringe_px: 0.3, flare: 0.02 },
                mosaic: true,
                denoise: Denoise::Bilateral { sigma_px: 0.9, range_levels: 6.0 },
                local_tone: Some(LocalTone { strength: 0.35, max_gain: 4.0, neighbourhood: 0.1 }),
                tone: ToneCurve::Srgb,
                sharpen: Some(Sharpen { radius_px: 0.8, amount: 0.6, limit_levels: 48.0 }),
                jpeg_quality: Some(92),
                ..Processing::LINEAR
            },
            // The USB camera's picture in a stream. Of 1296 x 972 pixels at 30 Hz in a descent above grass x264 (`veryfast`, no B-frames)
            // makes 2.5 Mbit/s with a quantiser of 28 and 1.1 with 34.
            Self::IpCamera => Processing {
                jpeg_quality: None,
                video: Some(Video { quantiser: 31, key_frame_every: 50 }),
                ..Self::Usb.processing()
            },
        }
    }
}

impl fmt::Display for Preset {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for Preset {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        Self::ALL.into_iter().find(|preset| preset.name() == text).ok_or_else(|| {
            let known = Self::ALL.map(Self::name).join(", ");
            format!("unknown processing `{text}`; it must be one of {known}")
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn presets_are_found_by_name_and_are_valid() {
        for preset in Preset::ALL {
            assert_eq!(preset.to_string().parse(), Ok(preset));
            assert_eq!(preset.processing().check(), Ok(()), "{preset}");
        }
        let problem = "webcam".parse::<Preset>().unwrap_err();
        for preset in Preset::ALL {
            assert!(problem.contains(preset.name()), "{problem}");
        }
    }

    #[test]
    fn the_curve_of_the_raspberry_pi_is_near_its_tuning() {
        // Some points of that file's gamma curve, of 65535.
        for (light, level) in [(4096.0, 15312.0), (16384.0, 40642.0), (32768.0, 54876.0)] {
            let is = Preset::RaspberryPi.processing().tone.level(light / 65535.0);
            assert!((is - level / 65535.0).abs() < 0.03, "{light}: {is}");
        }
    }
}
