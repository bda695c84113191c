//! Writes the sheet as PNG, with the size of its pixels, anti-aliased.

use anyhow::Context;
use image::GrayImage;
use markers::Ink;
use png::{BitDepth, ColorType, Compression, Encoder, PixelDimensions, Unit};

use super::glyphs;
use super::sheet::{Mark, Sheet, SheetError};

/// Samples per pixel in each direction.
const SAMPLES: usize = 4;
/// Maximum number of pixels of an image.
const MAX_PIXELS: f64 = 200e6;
const MM_PER_INCH: f64 = 25.4;

/// The bytes of the PNG file, with `dpi` pixels per inch.
pub(super) fn image(sheet: &Sheet, dpi: u16) -> anyhow::Result<Vec<u8>> {
    let pixels = raster(sheet, dpi)?;
    let per_metre = (f64::from(dpi) / MM_PER_INCH * 1e3).round() as u32;
    let mut bytes = Vec::new();
    let mut encoder = Encoder::new(&mut bytes, pixels.width(), pixels.height());
    encoder.set_color(ColorType::Grayscale);
    encoder.set_depth(BitDepth::Eight);
    encoder.set_compression(Compression::Fast);
    // Without the size of its pixels a program prints the image at any size.
    let size = PixelDimensions { xppu: per_metre, yppu: per_metre, unit: Unit::Meter };
    encoder.set_pixel_dims(Some(size));
    let mut writer = encoder.write_header().context("encoding the PNG")?;
    writer.write_image_data(pixels.as_raw()).context("encoding the PNG")?;
    writer.finish().context("encoding the PNG")?;
    Ok(bytes)
}

fn raster(sheet: &Sheet, dpi: u16) -> Result<GrayImage, SheetError> {
    let per_mm = f64::from(dpi) / MM_PER_INCH;
    let [width, height] = sheet.size_mm.map(|edge| (edge * per_mm).round() as u32);
    if f64::from(width) * f64::from(height) > MAX_PIXELS {
        let area_mm2 = sheet.size_mm[0] * sheet.size_mm[1];
        let max_dpi = ((MAX_PIXELS / area_mm2).sqrt() * MM_PER_INCH) as u32 - 1;
        return Err(SheetError::TooManyPixels { pixels: [width, height], max_dpi });
    }
    let marks: Vec<Mark> = sheet.marks.iter().flat_map(as_shapes).collect();
    let mut image = GrayImage::new(width, height);
    let mut band = vec![[true; SAMPLES]; width as usize * SAMPLES];
    for (y, row) in image.rows_mut().enumerate() {
        band.fill([true; SAMPLES]);
        for line in 0..SAMPLES {
            let y_mm = (y as f64 + (line as f64 + 0.5) / SAMPLES as f64) / per_mm;
            for mark in &marks {
                if let Some((from_mm, to_mm, ink)) = span(mark, y_mm) {
                    let column =
                        |mm: f64| (mm * per_mm * SAMPLES as f64 - 0.5).ceil().max(0.0) as usize;
                    let end = column(to_mm).min(band.len());
                    let start = column(from_mm).min(end);
                    band[start..end].iter_mut().for_each(|s| s[line] = ink == Ink::White);
                }
            }
        }
        for (pixel, samples) in row.zip(band.chunks_exact(SAMPLES)) {
            let white = samples.iter().flatten().filter(|is_white| **is_white).count();
            pixel.0 = [(white * 255 / (SAMPLES * SAMPLES)) as u8];
        }
    }
    Ok(image)
}

/// Converts text to rectangles.
fn as_shapes(mark: &Mark) -> Vec<Mark> {
    match mark {
        Mark::Text { at_mm, text } => glyphs::rectangles(text, *at_mm)
            .map(|(min_mm, max_mm)| Mark::Rectangle { min_mm, max_mm, ink: Ink::Black })
            .collect(),
        other => vec![other.clone()],
    }
}

/// The part of the horizontal line at `y_mm` that a mark covers.
fn span(mark: &Mark, y_mm: f64) -> Option<(f64, f64, Ink)> {
    match mark {
        Mark::Disc { centre_mm, radius_mm, ink } => {
            let dy = y_mm - centre_mm[1];
            let half = (radius_mm * radius_mm - dy * dy).max(0.0).sqrt();
            (half > 0.0).then_some((centre_mm[0] - half, centre_mm[0] + half, *ink))
        }
        Mark::Rectangle { min_mm, max_mm, ink } => {
            (min_mm[1]..max_mm[1]).contains(&y_mm).then_some((min_mm[0], max_mm[0], *ink))
        }
        Mark::Text { .. } => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::marker::sheet::Paper;
    use markers::{Drawing, Marker};

    #[test]
    fn the_image_matches_the_drawing() {
        let marker: Marker = "rings".parse().unwrap();
        let (size_m, dpi) = (0.15341, 300);
        let sheet = Sheet::new(&marker, size_m, Paper::A4).unwrap();
        let image = raster(&sheet, dpi).unwrap();
        assert_eq!(image.dimensions(), (2480, 3508));
        let drawing = Drawing::new(&marker, size_m).unwrap();
        let per_m = f64::from(dpi) / 0.0254;
        let reach = drawing.half_extent_m;
        let mut compared = 0;
        for i in 0..400 {
            for j in 0..400 {
                let [x, y] = [i, j].map(|k| (f64::from(k) / 199.5 - 1.0) * reach);
                let ink = drawing.ink_at(x, y);
                // Pixels on an edge have a value in between.
                let around = [(-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0), (1.0, 1.0)];
                if around
                    .iter()
                    .any(|(dx, dy)| drawing.ink_at(x + dx / per_m, y + dy / per_m) != ink)
                {
                    continue;
                }
                let px = ((0.105 + x) * per_m).floor() as u32;
                let py = ((0.1485 - y) * per_m).floor() as u32;
                let expected = if ink == Ink::White { 255 } else { 0 };
                assert_eq!(image.get_pixel(px, py)[0], expected, "at {x}, {y}");
                compared += 1;
            }
        }
        assert!(compared > 155_000, "{compared}");
    }

    #[test]
    fn the_black_area_is_that_of_the_rings() {
        let sheet = Sheet::new(&"rings".parse().unwrap(), 0.1, Paper::A4).unwrap();
        let image = raster(&sheet, 254).unwrap();
        // Ten pixels per millimetre; the quiet zone is 120 mm wide.
        let (x, y) = (1050, 1485);
        let darkness: u64 = (y - 600..y + 600)
            .flat_map(|y| (x - 600..x + 600).map(move |x| (x, y)))
            .map(|(x, y)| 255 - u64::from(image.get_pixel(x, y)[0]))
            .sum();
        let squares = [(50.0, 40.0), (25.0, 15.0), (3.0, 1.0)];
        let area_mm2: f64 = squares
            .iter()
            .map(|(outer, inner): &(f64, f64)| outer * outer - inner * inner)
            .sum::<f64>()
            * std::f64::consts::PI;
        let measured_mm2 = darkness as f64 / 255.0 / 100.0;
        assert!((measured_mm2 / area_mm2 - 1.0).abs() < 1e-4, "{measured_mm2} {area_mm2}");
    }

    #[test]
    fn the_file_states_the_size_of_its_pixels() {
        let sheet = Sheet::new(&"rings".parse().unwrap(), 0.1, Paper::A5).unwrap();
        let png = image(&sheet, 100).unwrap();
        assert_eq!(&png[33..45], b"\0\0\0\x09pHYs\0\0\x0f\x61");
        assert_eq!(image::load_from_memory(&png).unwrap().width(), 583);
    }

    #[test]
    fn too_many_pixels_are_refused() {
        let sheet = Sheet::new(&"rings".parse().unwrap(), 0.1, Paper::A0).unwrap();
        let problem = raster(&sheet, 1200).unwrap_err();
        let SheetError::TooManyPixels { max_dpi, .. } = problem else { panic!("{problem}") };
        assert!((300..400).contains(&max_dpi), "{max_dpi}");
    }
}
