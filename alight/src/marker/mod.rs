//! `alight marker`: writes a marker or a pad to print, true to scale, as PDF, SVG or PNG by the ending of the
//! file's name.

mod glyphs;
mod pdf;
mod png;
mod sheet;
mod svg;

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::Context;
use clap::Args;
use markers::{Marker, Pad};
use node::read_text;

use crate::ending::{Ending, format_of};
use crate::terminal::print;
pub(crate) use sheet::{Paper, Sheet, SheetError};

/// The arguments of `alight marker`.
#[derive(Args, Clone, Debug)]
pub(crate) struct MarkerArgs {
    /// The marker: FAMILY:ID, or FAMILY for a family without ids (rings). A wrong name lists all families; `rings-thesis` is the thesis'
    /// own detection of the same rings, kept for comparison, and finds few markers in pictures of ordinary cameras.
    #[arg(required_unless_present = "pad")]
    marker: Option<Marker>,
    /// A pad of several markers instead of one marker: the built-in `a4`, or a TOML file.
    #[arg(long, value_name = "PAD", conflicts_with_all = ["marker", "size"])]
    pad: Option<String>,
    /// Its size in metres: the outer diameter of rings, the side of the outer black square of others.
    #[arg(long, value_name = "M", value_parser = size_m)]
    size: Option<f64>,
    /// The paper size.
    #[arg(long, value_enum, ignore_case = true, default_value_t = Paper::A4)]
    paper: Paper,
    /// The output file; its name ends in .pdf, .svg or .png.
    #[arg(short, long, value_name = "FILE")]
    output: Output,
    /// Pixels per inch of a PNG.
    #[arg(long, value_name = "N", default_value_t = 300, value_parser = clap::value_parser!(u16).range(30..=2400))]
    dpi: u16,
}

/// An output file and its format, from the extension.
#[derive(Clone, Debug)]
pub(crate) struct Output {
    path: PathBuf,
    format: FileFormat,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum FileFormat {
    Pdf,
    Svg,
    Png,
}

impl std::str::FromStr for Output {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let path = PathBuf::from(text);
        let formats = [
            Ending::new("pdf", FileFormat::Pdf),
            Ending::new("svg", FileFormat::Svg),
            Ending::new("png", FileFormat::Png),
        ];
        let format = format_of(&path, &formats)?;
        Ok(Self { path, format })
    }
}

impl Output {
    /// The file's path.
    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    /// Writes a sheet, as PNG with `dpi` pixels per inch.
    ///
    /// # Errors
    /// The file cannot be written, or the image is too large.
    pub(crate) fn write(&self, sheet: &Sheet, dpi: u16) -> anyhow::Result<()> {
        let bytes = match self.format {
            FileFormat::Pdf => pdf::document(sheet),
            FileFormat::Svg => svg::document(sheet).into_bytes(),
            FileFormat::Png => png::image(sheet, dpi)?,
        };
        std::fs::write(&self.path, bytes).with_context(|| format!("writing {:?}", self.path))
    }
}

fn size_m(text: &str) -> Result<f64, String> {
    let (min, max) = Marker::SIZE_LIMITS_M;
    let number: Option<f64> = text.parse().ok();
    number
        .filter(|m| (min..=max).contains(m))
        .ok_or_else(|| format!("a size is a number of metres from {min} to {max}"))
}

/// Writes the file.
///
/// # Errors
/// [`SheetError`] when the sheet is impossible; else when the file cannot be written.
pub(crate) fn run(args: &MarkerArgs) -> anyhow::Result<ExitCode> {
    let (sheet, what) = match (&args.marker, &args.pad) {
        (Some(marker), _) => {
            let size_m = stated_size(args.size, marker)?;
            (Sheet::new(marker, size_m, args.paper)?, format!("{}, {size_m} m", marker.name()))
        }
        (None, pad) => {
            let name = pad.as_deref().unwrap_or_default();
            let pad = Pad::named(name, |file| read_text(file))?;
            (Sheet::with_pad(&pad, args.paper)?, sheet::pad_title(&pad))
        }
    };
    args.output.write(&sheet, args.dpi)?;
    print(&format!(
        "{}: {what}, on {}. Print it at 100 %, then check that the ruler below it measures 100 mm.",
        args.output.path.display(),
        args.paper.name()
    ))
    .context("writing the result")?;
    Ok(ExitCode::SUCCESS)
}

fn stated_size(by_option: Option<f64>, marker: &Marker) -> Result<f64, SheetError> {
    match (by_option, marker.size_m) {
        (Some(size), Some(other)) if size != other => Err(SheetError::TwoSizes { size, other }),
        (Some(size), _) | (None, Some(size)) => Ok(size),
        (None, None) => Err(SheetError::NoSize),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;

    #[derive(Parser)]
    struct Program {
        #[command(flatten)]
        args: MarkerArgs,
    }

    fn write(text: &[&str]) -> Result<(), String> {
        let text = std::iter::once(&"marker").chain(text);
        let args = Program::try_parse_from(text).map_err(|e| e.to_string())?.args;
        run(&args).map(drop).map_err(|e| format!("{e:#}"))
    }

    #[test]
    fn the_extension_selects_the_format() {
        let folder = tempfile::tempdir().unwrap();
        for (name, start) in [("a.pdf", &b"%PDF-1"[..]), ("b.SVG", b"<svg"), ("c.png", b"\x89PNG")]
        {
            let path = folder.path().join(name);
            let text = path.to_str().unwrap();
            write(&["rings", "--size", "0.15341", "--dpi", "72", "-o", text]).unwrap();
            assert!(std::fs::read(&path).unwrap().starts_with(start), "{name}");
        }
    }

    #[test]
    fn a_pad_is_written_on_one_sheet() {
        let folder = tempfile::tempdir().unwrap();
        for name in ["a.pdf", "a.svg", "a.png"] {
            let path = folder.path().join(name);
            write(&["--pad", "a4", "--dpi", "72", "-o", path.to_str().unwrap()]).unwrap();
            assert!(path.metadata().unwrap().len() > 1000, "{name}");
        }
        let path = folder.path().join("a.pdf");
        let problem = write(&["--pad", "a4", "--paper", "a5", "-o", path.to_str().unwrap()]);
        assert!(problem.unwrap_err().contains("it fits on a4"));
        let problem = write(&["--pad", "no/such.toml", "-o", path.to_str().unwrap()]).unwrap_err();
        assert!(problem.contains("no/such.toml"), "{problem}");
    }

    #[test]
    fn every_family_is_written() {
        let folder = tempfile::tempdir().unwrap();
        for family in markers::Family::ALL {
            let marker = match family.id_count() {
                Some(count) => format!("{family}:{}:0.07", count - 1),
                None => format!("{family}:0.07"),
            };
            for name in ["a.pdf", "a.svg", "a.png"] {
                let path = folder.path().join(name);
                write(&[&marker, "--dpi", "72", "-o", path.to_str().unwrap()]).unwrap();
            }
        }
    }

    #[test]
    fn wrong_use_is_explained() {
        let check = |text: &[&str], part: &str| {
            let problem = write(text).unwrap_err();
            assert!(problem.contains(part), "`{part}` is not in: {problem}");
        };
        check(&["rings", "--size", "0.1", "-o", "a.gif"], ".pdf, .svg or .png");
        check(&["rings", "--size", "0.1"], "--output");
        check(&["rings", "-o", "a.pdf"], "--size");
        check(&["rings:0.2", "--size", "0.1", "-o", "a.pdf"], "two sizes");
        check(&["apriltag-16h5", "--size", "0.1", "-o", "a.pdf"], "missing id");
        check(&["rings", "--size", "0", "-o", "a.pdf"], "from 0.001 to 100");
        check(&["ring", "--size", "0.1", "-o", "a.pdf"], "known are");
        check(&["rings", "--size", "0.1", "--paper", "b5", "-o", "a.pdf"], "a4");
        check(&["rings", "--size", "0.1", "--dpi", "5", "-o", "a.png"], "30..=2400");
        check(&["rings", "--size", "0.1", "-o", "no/such/folder/a.pdf"], "no/such/folder/a.pdf");
        let large = ["rings", "--size", "0.6", "--paper", "a0", "--dpi", "1200", "-o", "a.png"];
        check(&large, "pixels");
    }
}
