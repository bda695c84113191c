//! Finds cycles in a graph, and makes the graph of the modules of a crate.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use crate::source::{tokens, without_tests};

/// The nodes that each node needs.
pub(crate) type Graph = BTreeMap<String, BTreeSet<String>>;

/// The sets of nodes that need each other, directly or by way of others.
pub(crate) fn circles(graph: &Graph) -> Vec<BTreeSet<String>> {
    let reached: BTreeMap<&String, BTreeSet<&String>> =
        graph.keys().map(|node| (node, reached_from(graph, node))).collect();
    let mut found: Vec<BTreeSet<String>> = Vec::new();
    for (node, others) in &reached {
        if !others.contains(node) || found.iter().any(|circle| circle.contains(*node)) {
            continue;
        }
        let back = |other: &&&String| reached.get(**other).is_some_and(|them| them.contains(node));
        found.push(others.iter().filter(back).map(|other| (*other).clone()).collect());
    }
    found
}

fn reached_from<'a>(graph: &'a Graph, node: &String) -> BTreeSet<&'a String> {
    let mut reached = BTreeSet::new();
    let mut waiting: Vec<&String> = graph.get(node).into_iter().flatten().collect();
    while let Some(next) = waiting.pop() {
        if reached.insert(next) {
            waiting.extend(graph.get(next).into_iter().flatten());
        }
    }
    reached
}

/// A module: its file, the modules that it declares, and the items that it re-exports.
#[derive(Default)]
struct Module {
    code: String,
    children: BTreeSet<String>,
    passed_on: BTreeMap<String, Vec<String>>,
}

/// The modules of a crate by their paths (`a::b`; the crate's root is `crate`), and the modules that each of them uses.
///
/// A module uses another one when it names an item of it. Not counted: a module's declaration, uses by a module's children
/// (they are parts of it), and names that the crate's root re-exports.
pub(crate) fn modules(src: &Path, files: &[PathBuf]) -> std::io::Result<Graph> {
    let mut modules = BTreeMap::new();
    for file in files {
        let inside = file.strip_prefix(src).unwrap_or(file).with_extension("");
        let mut path: Vec<String> =
            inside.iter().map(|part| part.to_string_lossy().into_owned()).collect();
        if path.last().is_some_and(|last| last == "mod") || path == ["lib"] {
            path.pop();
        }
        let code = without_tests(&std::fs::read_to_string(file)?);
        modules.insert(path, Module { code, ..Module::default() });
    }
    // The program of a crate that has a library as well is another crate.
    if modules.contains_key(&Vec::new()) {
        modules.remove(&vec!["main".to_owned()]);
    } else if let Some(main) = modules.remove(&vec!["main".to_owned()]) {
        modules.insert(Vec::new(), main);
    }
    let paths: Vec<Vec<String>> = modules.keys().cloned().collect();
    for path in &paths {
        if let Some((name, parent)) = path.split_last()
            && let Some(parent) = modules.get_mut(parent)
        {
            parent.children.insert(name.clone());
        }
    }
    let mut uses = BTreeMap::new();
    for path in &paths {
        let found = paths_in(&modules[path]);
        if let Some(module) = modules.get_mut(path) {
            for (names, alias) in found.iter().filter(|(_, alias)| alias.is_some()) {
                module.passed_on.insert(alias.clone().unwrap_or_default(), names.clone());
            }
        }
        uses.insert(path.clone(), found);
    }
    let mut graph = Graph::new();
    for (path, uses) in &uses {
        let needed = graph.entry(name_of(path)).or_default();
        for (names, alias) in uses {
            if path.is_empty() && alias.is_some() {
                continue;
            }
            let target = resolve(&modules, path, names, 0);
            let is_part = |target: &[String]| {
                target == path || !target.is_empty() && path.starts_with(target)
            };
            let target = target.filter(|target| !is_part(target));
            needed.extend(target.map(|target| name_of(&target)));
        }
    }
    Ok(graph)
}

fn name_of(path: &[String]) -> String {
    if path.is_empty() { "crate".to_owned() } else { path.join("::") }
}

/// The module in which a name is defined that a module uses.
fn resolve(
    modules: &BTreeMap<Vec<String>, Module>,
    from: &[String],
    names: &[String],
    depth: usize,
) -> Option<Vec<String>> {
    let mut at = from.to_vec();
    let mut names = names.iter().peekable();
    match names.peek().map(|name| name.as_str())? {
        "crate" => {
            at.clear();
            names.next();
        }
        "self" => drop(names.next()),
        "super" => {
            while names.next_if(|name| *name == "super").is_some() {
                at.pop();
            }
        }
        _ => {}
    }
    for name in names {
        let module = modules.get(&at)?;
        if module.children.contains(name) {
            at.push(name.clone());
        } else if let Some(passed_on) = module.passed_on.get(name).filter(|_| depth < 9) {
            return resolve(modules, &at, passed_on, depth + 1).or(Some(at));
        } else {
            break;
        }
    }
    Some(at)
}

/// The paths that a module names, each with the name under which it is passed on.
fn paths_in(module: &Module) -> Vec<(Vec<String>, Option<String>)> {
    let tokens = tokens(&module.code);
    let mut found = Vec::new();
    let mut at = 0;
    while at < tokens.len() {
        let is_public = tokens[at] == "pub";
        let begin = match tokens[at] {
            "pub" if tokens.get(at + 1) == Some(&"use") => at + 2,
            // `pub(crate) use`
            "pub" if tokens.get(at + 4) == Some(&"use") => at + 5,
            "use" => at + 1,
            "crate" | "super" | "self" if tokens.get(at + 1) == Some(&"::") => at,
            name if tokens.get(at + 1) == Some(&"::")
                && module.children.contains(name)
                && (at == 0 || tokens[at - 1] != "::") =>
            {
                at
            }
            _ => {
                at += 1;
                continue;
            }
        };
        let is_use = begin > at;
        let mut tree = Vec::new();
        at = tree_at(&tokens, begin, &[], is_use, &mut tree);
        for (names, alias) in tree {
            let first = names.first().map(String::as_str).unwrap_or_default();
            let is_ours =
                ["crate", "super", "self"].contains(&first) || module.children.contains(first);
            if is_ours {
                found.push((names, alias.filter(|_| is_public)));
            }
        }
    }
    found
}

/// Reads a path, in a `use` with its braces; the answer is where it ends.
fn tree_at(
    tokens: &[&str],
    mut at: usize,
    prefix: &[String],
    is_use: bool,
    found: &mut Vec<(Vec<String>, Option<String>)>,
) -> usize {
    let mut names = prefix.to_vec();
    loop {
        match tokens.get(at).copied() {
            Some("{") if is_use => {
                at += 1;
                while tokens.get(at).is_some_and(|token| *token != "}") {
                    at = tree_at(tokens, at, &names, true, found);
                    at += usize::from(tokens.get(at) == Some(&","));
                }
                return at + 1;
            }
            Some(name) if name.starts_with(|c: char| c.is_alphabetic() || c == '_') => {
                names.push(name.to_owned());
                at += 1;
            }
            // `*`, or the text after a turbofish.
            _ => break,
        }
        if tokens.get(at) != Some(&"::") {
            break;
        }
        at += 1;
    }
    let mut alias = names.last().cloned();
    if is_use && tokens.get(at) == Some(&"as") {
        alias = tokens.get(at + 1).map(|name| (*name).to_owned());
        at += 2;
    }
    at += usize::from(is_use && tokens.get(at) == Some(&"*"));
    if names.last().is_some_and(|last| last == "self") && names.len() > 1 {
        names.pop();
    }
    found.push((names, alias));
    at.max(1)
}
