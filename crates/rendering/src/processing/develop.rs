//! Develops the light on the sensor, with its noise, into the camera's frame.

use super::filters::{self, Gaussian};
use super::jpeg::Jpeg;
use super::tone::{Table, ToneCurve};
use super::video::VideoCoder;
use super::{Denoise, Processing, Sharpen, local, mosaic};
use crate::error::RenderError;
use crate::quantise::quantise;

/// A camera's processing with its tables and buffers.
#[derive(Debug)]
pub(crate) struct Developer {
    processing: Processing,
    width: usize,
    table: Option<Table>,
    mask: Option<(Gaussian, Sharpen)>,
    jpeg: Option<Jpeg>,
    video: Option<VideoCoder>,
    /// Light on the sensor in levels from 0 to 255, row by row.
    raw: Vec<f32>,
    padded: Vec<f32>,
    work: Vec<f32>,
    blurred: Vec<f32>,
}

impl Developer {
    pub(crate) fn new(processing: &Processing, width: usize) -> Result<Self, RenderError> {
        processing.check()?;
        let tone = processing.tone;
        Ok(Self {
            processing: *processing,
            width,
            table: (tone != ToneCurve::Linear).then(|| Table::new(tone)),
            mask: processing.sharpen.map(|sharpen| (Gaussian::new(sharpen.radius_px), sharpen)),
            jpeg: processing.jpeg_quality.map(Jpeg::new),
            video: processing.video.map(VideoCoder::new),
            raw: Vec::new(),
            padded: Vec::new(),
            work: Vec::new(),
            blurred: Vec::new(),
        })
    }

    /// The light of `len` pixels, to be written, then the sensor's values.
    pub(crate) fn raw(&mut self, len: usize) -> &mut [f32] {
        self.raw.resize(len, 0.0);
        &mut self.raw
    }

    /// Takes the light of frame `frame_index` through the lens and, for a sensor with a mosaic, its colour
    /// filters.
    pub(crate) fn pass_lens(&mut self, frame_index: u64) {
        let width = self.width.max(1);
        let Processing { lens, unsteady, mosaic, .. } = self.processing;
        lens.spread(&mut self.raw, width, &mut self.work, &mut self.blurred);
        if mosaic && lens.fringe_px != 0.0 {
            self.work.clone_from(&self.raw);
            lens.fringe(&self.work, &mut self.raw, width);
        }
        let height = self.raw.len() / width;
        for (v, row) in self.raw.chunks_mut(width).enumerate() {
            let gain = unsteady.gain(frame_index, v, height);
            if gain != 1.0 {
                row.iter_mut().for_each(|level| *level *= gain);
            }
            if mosaic {
                mosaic::filter(v, row);
            }
        }
    }

    /// Develops the light that was written to the sensor.
    pub(crate) fn develop(&mut self, out: &mut [u8]) -> Result<(), RenderError> {
        let width = self.width;
        if width == 0 || out.len() != self.raw.len() || !out.len().is_multiple_of(width) {
            return Err(RenderError::Size { len: out.len(), needed: self.raw.len() });
        }
        let Self { raw, padded, .. } = self;
        if self.processing.mosaic {
            filters::pad(raw, width, true, padded);
            mosaic::interpolate(padded, width, raw);
        }
        match self.processing.denoise {
            Denoise::None => {}
            Denoise::Median => {
                filters::pad(raw, width, false, padded);
                filters::median(padded, width, raw);
            }
            Denoise::Bilateral { sigma_px, range_levels } => {
                filters::pad(raw, width, false, padded);
                filters::bilateral(padded, width, sigma_px, range_levels, raw);
            }
        }
        if let Some(local) = &self.processing.local_tone {
            local::adapt(local, raw, width);
        }
        if let Some(table) = &self.table {
            table.apply(raw);
        }
        if let Some((gaussian, sharpen)) = &self.mask {
            gaussian.blur(raw, width, &mut self.work, &mut self.blurred);
            let limit = sharpen.limit_levels;
            for (level, soft) in raw.iter_mut().zip(&self.blurred) {
                *level += (sharpen.amount * (*level - soft)).clamp(-limit, limit);
            }
        }
        for (pixel, level) in out.iter_mut().zip(&*raw) {
            *pixel = quantise(*level);
        }
        if let Some(jpeg) = &self.jpeg {
            jpeg.apply(out, width);
        }
        if let Some(video) = &mut self.video {
            video.apply(out, width);
        }
        Ok(())
    }
}
