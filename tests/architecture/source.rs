//! Reads the code of a Rust source file without comments, literals and tests, as tokens.

/// The code of a file: comments and contents of literals are blanks, and items under `#[cfg(test)]` are left out.
pub(crate) fn without_tests(source: &str) -> String {
    let mut code = without_text(source);
    while let Some(begin) = code.find("#[cfg(test)]") {
        let end = begin + item_len(&code[begin..]);
        code.replace_range(begin..end, "");
    }
    code
}

/// Lines that have code in them.
pub(crate) fn lines_of_code(source: &str) -> usize {
    without_tests(source).lines().filter(|line| !line.trim().is_empty()).count()
}

/// The length of an item with its attributes: up to its first semicolon outside of brackets, or its braces' end.
fn item_len(code: &str) -> usize {
    let mut depth = 0;
    for (at, c) in code.char_indices() {
        match c {
            '{' | '(' | '[' => depth += 1,
            '}' | ')' | ']' => depth -= 1,
            _ => {}
        }
        if depth == 0 && (c == ';' || c == '}') {
            return at + 1;
        }
    }
    code.len()
}

/// The source with blanks instead of comments and contents of literals; line numbers do not change.
fn without_text(source: &str) -> String {
    let bytes = source.as_bytes();
    let mut code = String::with_capacity(source.len());
    let mut at = 0;
    let lines = |part: &str| "\n".repeat(part.matches('\n').count());
    while at < bytes.len() {
        let rest = &source[at..];
        let len = if rest.starts_with("//") {
            rest.find('\n').unwrap_or(rest.len())
        } else if rest.starts_with("/*") {
            rest.find("*/").map_or(rest.len(), |end| end + 2)
        } else if let Some(len) = raw_string_len(rest, &code) {
            len
        } else if rest.starts_with('"') {
            string_len(rest)
        } else if let Some(len) = character_len(rest) {
            len
        } else {
            let c = rest.chars().next().unwrap_or_default();
            code.push(c);
            at += c.len_utf8();
            continue;
        };
        // A literal stays a value.
        if rest.starts_with(['"', 'r', '\'']) {
            code.push_str("\"\"");
        }
        code.push_str(&lines(&rest[..len]));
        at += len;
    }
    code
}

fn raw_string_len(rest: &str, before: &str) -> Option<usize> {
    let is_word = before.ends_with(|c: char| c.is_alphanumeric() && c != 'b' || c == '_');
    let hashes = rest.strip_prefix('r').filter(|_| !is_word)?;
    let marks = hashes.len() - hashes.trim_start_matches('#').len();
    hashes[marks..].strip_prefix('"')?;
    let end = format!("\"{}", "#".repeat(marks));
    let begin = 2 + marks;
    Some(begin + rest[begin..].find(&end).map_or(rest.len() - begin, |at| at + end.len()))
}

fn string_len(rest: &str) -> usize {
    let mut escaped = false;
    for (at, c) in rest.char_indices().skip(1) {
        match c {
            _ if escaped => escaped = false,
            '\\' => escaped = true,
            '"' => return at + 1,
            _ => {}
        }
    }
    rest.len()
}

/// The length of a character literal; `None` for a lifetime.
fn character_len(rest: &str) -> Option<usize> {
    let inner = rest.strip_prefix('\'')?;
    let mut chars = inner.char_indices();
    let (_, first) = chars.next()?;
    if first == '\\' {
        return inner[2..].find('\'').map(|end| end + 4);
    }
    let (at, second) = chars.next()?;
    (second == '\'').then_some(at + 2)
}

/// Names, `::`, and single other characters.
pub(crate) fn tokens(code: &str) -> Vec<&str> {
    let mut found = Vec::new();
    let mut rest = code;
    while let Some(c) = rest.chars().next() {
        let is_name = |c: char| c.is_alphanumeric() || c == '_';
        let len = match c {
            _ if is_name(c) => rest.find(|c| !is_name(c)).unwrap_or(rest.len()),
            ':' if rest.starts_with("::") => 2,
            _ => c.len_utf8(),
        };
        if !c.is_whitespace() {
            found.push(&rest[..len]);
        }
        rest = &rest[len..];
    }
    found
}
