//! Makes the list of source files in ARCHITECTURE.md: each with the first sentence of its documentation and its definitions.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

/// Maximum number of names that are listed of a file.
const MAX_NAMES: usize = 60;
/// Folders of a room, in the order of the list. The package `tests` is a room that is one folder.
const FOLDERS: [&str; 4] = ["src", "tests", "examples", "benches"];

/// The list as it must stand in the document.
///
/// `files` are paths from the root of the repository; `read` gives the text of one.
pub(crate) fn list<'a>(
    files: impl Iterator<Item = &'a Path>,
    read: impl Fn(&Path) -> anyhow::Result<String>,
) -> anyhow::Result<String> {
    let mut texts = vec![];
    for file in files {
        let Some(place) = file.to_str().and_then(place) else { continue };
        texts.push((file, place, read(file)?));
    }
    let mut files_with: BTreeMap<&str, usize> = BTreeMap::new();
    for (_, _, text) in &texts {
        for member in members(text) {
            *files_with.entry(member).or_default() += 1;
        }
    }

    let mut rooms: BTreeMap<(&str, usize), BTreeMap<String, String>> = BTreeMap::new();
    for (file, (room, folder, within), text) in &texts {
        let sentence = first_sentence(text);
        anyhow::ensure!(!sentence.is_empty(), "{} does not begin with `//!`", file.display());
        let names = names(text, |member| files_with.get(member) == Some(&1));
        let line = format!("- `{within}`: {sentence}{names}");
        rooms.entry((*room, *folder)).or_default().insert(sort_key(within), line);
    }
    let sections = rooms.iter().map(|((room, folder), files)| {
        let lines: Vec<&str> = files.values().map(String::as_str).collect();
        let folder = if room.is_empty() { "" } else { "/" }.to_owned() + FOLDERS[*folder];
        format!("### `{room}{folder}`\n\n{}\n", lines.join("\n"))
    });
    Ok(sections.collect::<Vec<_>>().join("\n"))
}

/// The room of a file, the index of its folder there, and its path in that folder.
fn place(file: &str) -> Option<(&str, usize, &str)> {
    if let Some(within) = file.strip_prefix("tests/") {
        return Some(("", 1, within));
    }
    FOLDERS.iter().enumerate().find_map(|(index, folder)| {
        let (room, within) = file.split_once(&format!("/{folder}/"))?;
        Some((room, index, within))
    })
}

/// The definitions in a file, without its tests: types, functions, methods that are no trait's, constants, then those fields and variants
/// that `is_only_here`; the first of them.
fn names(text: &str, is_only_here: impl Fn(&str) -> bool) -> String {
    let (mut is_test, mut of_trait) = (false, false);
    let (mut types, mut functions, mut methods, mut constants) = (vec![], vec![], vec![], vec![]);
    for line in before_tests(text).lines() {
        let was_test = is_test;
        is_test = line.starts_with("#[test]")
            || line.starts_with("#[tokio::test")
            || (is_test && line.starts_with("#["));
        if line.starts_with("impl") || line == "}" {
            of_trait = line.contains(" for ");
        }
        if let Some(inner) = line.strip_prefix("    ") {
            methods.extend(defined(inner, &["fn "]).filter(|name| !of_trait && *name != "new"));
        } else if !was_test {
            types.extend(defined(line, &["struct ", "enum ", "trait ", "union ", "type "]));
            functions.extend(defined(line, &["fn ", "macro_rules! "]));
            constants.extend(defined(line, &["const ", "static "]));
        }
    }
    let mut seen = BTreeSet::new();
    let members = members(text).into_iter().filter(|name| is_only_here(name)).collect();
    let names = [types, functions, methods, constants, members].into_iter().flatten();
    let names = names.filter(|name| seen.insert(*name));
    let names: Vec<String> = names.take(MAX_NAMES).map(|name| format!("`{name}`")).collect();
    if names.is_empty() { String::new() } else { format!(" ({})", names.join(", ")) }
}

/// The names of fields and variants of the structs and enums in a file, without its tests.
fn members(text: &str) -> BTreeSet<&str> {
    let (mut is_struct, mut is_enum) = (false, false);
    let mut members = BTreeSet::new();
    for line in before_tests(text).lines() {
        if !line.starts_with(' ') {
            let opens = line.ends_with('{');
            is_struct = opens && defined(line, &["struct "]).is_some();
            is_enum = opens && defined(line, &["enum "]).is_some();
            continue;
        }
        let line = line.trim_start();
        let line = line
            .strip_prefix("pub(")
            .and_then(|rest| rest.split_once(") "))
            .map_or(line, |it| it.1);
        let line = line.strip_prefix("pub ").unwrap_or(line);
        let end = line.find(|c: char| !c.is_alphanumeric() && c != '_').unwrap_or(line.len());
        let (name, rest) = line.split_at(end);
        let is_field =
            rest.starts_with(": ") && name.starts_with(|first: char| first.is_lowercase());
        let is_variant = is_enum
            && name.starts_with(|first: char| first.is_uppercase())
            && [",", " {", "("].iter().any(|next| rest.starts_with(next));
        if ((is_struct || is_enum) && is_field) || is_variant {
            members.insert(name);
        }
    }
    members
}

/// A file's text up to its module of tests.
fn before_tests(text: &str) -> &str {
    text.split("\nmod tests {").next().unwrap_or_default()
}

/// The name that a line defines with one of these keywords, public or not.
fn defined<'a>(line: &'a str, keywords: &[&str]) -> Option<&'a str> {
    let line = ["pub(crate) ", "pub(super) ", "pub "]
        .iter()
        .find_map(|public| line.strip_prefix(public))
        .unwrap_or(line);
    let is_function = line.starts_with("const fn ");
    let line = if is_function { &line["const ".len()..] } else { line };
    let line = line.strip_prefix("async ").unwrap_or(line);
    let rest = keywords.iter().find_map(|keyword| line.strip_prefix(keyword))?;
    let end = rest.find(|c: char| !c.is_alphanumeric() && c != '_')?;
    Some(&rest[..end]).filter(|name| !name.is_empty() && *name != "_")
}

/// A module stands before those of its folder, and a library before its modules.
fn sort_key(within: &str) -> String {
    match within {
        "lib.rs" => String::new(),
        _ => within.trim_end_matches(".rs").trim_end_matches("/mod").to_owned(),
    }
}

/// The first sentence of a file's `//!` lines, without links.
fn first_sentence(text: &str) -> String {
    let lines = text.lines().map_while(|line| line.strip_prefix("//!")).map(str::trim);
    let paragraph = lines.take_while(|line| !line.is_empty()).collect::<Vec<_>>().join(" ");
    let sentence =
        match paragraph.match_indices(". ").find(|(at, _)| ends_sentence(&paragraph, *at)) {
            Some((at, _)) => &paragraph[..at],
            None => paragraph.strip_suffix('.').unwrap_or(&paragraph),
        };
    without_addresses(&sentence.replace("[`", "`").replace("`]", "`"))
}

/// Whether the full stop at `at` ends a sentence: the next word begins with a capital letter, or with code.
fn ends_sentence(paragraph: &str, at: usize) -> bool {
    paragraph[at + 2..].starts_with(|first: char| first.is_uppercase() || first == '`')
}

/// ` (<https://...>)` does not describe a file.
fn without_addresses(sentence: &str) -> String {
    match (sentence.find(" (<"), sentence.find(">)")) {
        (Some(begin), Some(end)) if begin < end => {
            format!("{}{}", &sentence[..begin], &sentence[end + 2..])
        }
        _ => sentence.to_owned(),
    }
}
