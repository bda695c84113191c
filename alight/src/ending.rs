//! Chooses a file's format by the ending of its name, and refuses other endings.

use std::path::{Path, PathBuf};

/// An ending of file names, and the format for which it stands.
pub(crate) struct Ending<T> {
    name: &'static str,
    format: T,
}

impl<T> Ending<T> {
    /// `name` is in lower case, without the point.
    pub(crate) const fn new(name: &'static str, format: T) -> Self {
        Self { name, format }
    }
}

/// The format that the ending of a file's name stands for, in upper or lower case.
///
/// # Errors
/// The known endings.
pub(crate) fn format_of<T: Copy>(file: &Path, formats: &[Ending<T>]) -> Result<T, String> {
    let ending = file.extension().unwrap_or_default().to_string_lossy().to_ascii_lowercase();
    let named = formats.iter().find(|known| known.name == ending).map(|known| known.format);
    named.ok_or_else(|| {
        let endings: Vec<String> = formats.iter().map(|known| format!(".{}", known.name)).collect();
        let endings = match endings.split_last() {
            Some((last, rest)) if !rest.is_empty() => format!("{} or {last}", rest.join(", ")),
            _ => endings.concat(),
        };
        format!("the name must end in {endings}")
    })
}

/// A recording to write, of the command line.
pub(crate) fn recording(text: &str) -> Result<PathBuf, String> {
    of_one_format(text, "mcap")
}

/// A picture to write, of the command line.
pub(crate) fn png_file(text: &str) -> Result<PathBuf, String> {
    of_one_format(text, "png")
}

/// A file of a configuration to write, of the command line.
pub(crate) fn toml_file(text: &str) -> Result<PathBuf, String> {
    of_one_format(text, "toml")
}

fn of_one_format(text: &str, ending: &'static str) -> Result<PathBuf, String> {
    let path = PathBuf::from(text);
    format_of(&path, &[Ending::new(ending, ())])?;
    Ok(path)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_ending_chooses_the_format_and_another_one_is_refused_with_those_there_are() {
        let formats = [Ending::new("yaml", 1), Ending::new("json", 2), Ending::new("xml", 3)];
        assert_eq!(format_of(Path::new("a/b.JSON"), &formats), Ok(2));
        for other in ["a.txt", "json", ".json", ""] {
            let problem = format_of(Path::new(other), &formats).unwrap_err();
            assert_eq!(problem, "the name must end in .yaml, .json or .xml", "{other}");
        }
        assert!(recording("flight.mcap").is_ok() && toml_file("flight.mcap").is_err());
        assert_eq!(recording("flight.bag").unwrap_err(), "the name must end in .mcap");
    }
}
