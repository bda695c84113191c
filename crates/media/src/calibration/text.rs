//! Parses the text of a calibration file into keys and values: YAML, and OpenCV's YAML, JSON or XML.

use serde_yaml_ng::{Mapping, Value};

/// How deep elements of XML may be nested.
const MAX_DEPTH: usize = 16;

/// The keys and values of a text, or its error as text.
pub(super) fn parse(text: &str) -> Result<Value, String> {
    let text = text.trim_start_matches('\u{feff}');
    if text.trim_start().starts_with('<') {
        return Xml { rest: text }
            .storage()
            .map_err(|problem| format!("is not valid XML: {problem}"));
    }
    // OpenCV writes a directive and a type tag that are not valid YAML.
    let body = match text.strip_prefix("%YAML") {
        Some(rest) => rest.split_once('\n').map_or("", |(_, body)| body),
        None => text,
    };
    let root: Value = serde_yaml_ng::from_str(&body.replace("!!opencv-matrix", ""))
        .map_err(|cause| format!("is not valid YAML: {cause}"))?;
    if root.is_mapping() { Ok(root) } else { Err("is not a list of keys and values".to_owned()) }
}

/// Reads the XML of OpenCV's `FileStorage`: elements with text or elements in them; attributes are not needed.
struct Xml<'a> {
    rest: &'a str,
}

/// A tag at the beginning or end of an element.
enum Tag<'a> {
    Start { name: &'a str, is_empty: bool },
    End,
}

impl<'a> Xml<'a> {
    fn storage(mut self) -> Result<Value, String> {
        self.skip_prolog()?;
        match self.tag()? {
            Tag::Start { name: "opencv_storage", is_empty: false } => self.content(MAX_DEPTH),
            _ => Err("its first element is not `opencv_storage`".to_owned()),
        }
        .and_then(|root| {
            if root.is_mapping() { Ok(root) } else { Err("it has no keys".to_owned()) }
        })
    }

    /// Skips declarations and comments.
    fn skip_prolog(&mut self) -> Result<(), String> {
        loop {
            self.rest = self.rest.trim_start();
            let end = if self.rest.starts_with("<?") {
                "?>"
            } else if self.rest.starts_with("<!--") {
                "-->"
            } else {
                return Ok(());
            };
            let (_, rest) =
                self.rest.split_once(end).ok_or_else(|| format!("there is no `{end}`"))?;
            self.rest = rest;
        }
    }

    fn tag(&mut self) -> Result<Tag<'a>, String> {
        let inside = self.rest.strip_prefix('<').ok_or("an element is missing")?;
        let (inside, rest) = inside.split_once('>').ok_or("there is a `<` without `>`")?;
        self.rest = rest;
        if inside.starts_with('/') {
            return Ok(Tag::End);
        }
        let is_empty = inside.ends_with('/');
        let name = inside.trim_end_matches('/').split_whitespace().next().unwrap_or_default();
        if name.is_empty() {
            Err("an element has no name".to_owned())
        } else {
            Ok(Tag::Start { name, is_empty })
        }
    }

    /// The content of an element up to its end.
    fn content(&mut self, depth: usize) -> Result<Value, String> {
        let deeper = depth.checked_sub(1).ok_or("it is nested too deeply")?;
        let (text, _) = self.rest.split_once('<').ok_or("an element does not end")?;
        let mut keys = Mapping::new();
        loop {
            let (_, rest) =
                self.rest.split_at(self.rest.find('<').ok_or("an element does not end")?);
            self.rest = rest;
            self.skip_prolog()?;
            if !self.rest.starts_with('<') {
                continue;
            }
            match self.tag()? {
                Tag::End if keys.is_empty() => return Ok(scalar_or_list(text)),
                Tag::End => return Ok(Value::Mapping(keys)),
                Tag::Start { name, is_empty } => {
                    let value = if is_empty { Value::Null } else { self.content(deeper)? };
                    keys.insert(Value::from(name), value);
                }
            }
        }
    }
}

/// Several words are a list, as numbers of a matrix are; a quoted text is one.
fn scalar_or_list(text: &str) -> Value {
    let text = text.trim();
    if let Some(quoted) = text.strip_prefix('"') {
        return Value::from(quoted.trim_end_matches('"'));
    }
    let words: Vec<&str> = text.split_whitespace().collect();
    let value = |word: &str| match (word.parse::<i64>(), word.parse::<f64>()) {
        (Ok(whole), _) => Value::from(whole),
        (_, Ok(number)) => Value::from(number),
        _ => Value::from(word),
    };
    match words.as_slice() {
        [] => Value::Null,
        [word] => value(word),
        words => Value::Sequence(words.iter().map(|word| value(word)).collect()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn xml_is_keys_and_values() {
        let text = "<?xml version=\"1.0\"?>\n<!-- by a program -->\n<opencv_storage>\n<when>\"a day\"</when>\n\
                    <size>640 480</size><!-- px --><matrix type_id=\"opencv-matrix\">\n <rows>2</rows>\n <data>1. \
                    -2e-3</data></matrix><none/></opencv_storage>\n";
        let root = parse(text).unwrap();
        assert_eq!(root["when"], Value::from("a day"));
        assert_eq!(root["size"], Value::Sequence(vec![640.into(), 480.into()]));
        assert_eq!(root["matrix"]["rows"], Value::from(2));
        assert_eq!(root["matrix"]["data"], Value::Sequence(vec![1.0.into(), (-2e-3).into()]));
        assert_eq!(root["none"], Value::Null);
    }

    #[test]
    fn xml_other_than_a_storage_is_refused() {
        for (text, problem) in [
            ("<svg></svg>", "not `opencv_storage`"),
            ("<opencv_storage>", "does not end"),
            ("<opencv_storage><a>1</a>", "does not end"),
            ("<opencv_storage>1</opencv_storage>", "no keys"),
            ("<!-- <opencv_storage>", "no `-->`"),
            ("<", "without `>`"),
            ("<>", "no name"),
        ] {
            let refusal = parse(text).unwrap_err();
            assert!(
                refusal.contains("not valid XML") && refusal.contains(problem),
                "{text}: {refusal}"
            );
        }
        let deep = format!("<opencv_storage>{}", "<a>".repeat(10_000));
        assert!(parse(&deep).unwrap_err().contains("too deeply"));
    }

    proptest! {
        #[test]
        fn no_text_panics(text in "(<|>|/|a|\\?|!--|-->| |1|\"|opencv_storage){0,40}") {
            let _ = parse(&text);
            let _ = parse(&format!("<opencv_storage>{text}</opencv_storage>"));
        }
    }
}
