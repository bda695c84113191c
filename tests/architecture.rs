//! Checks the documents against the tree (paths, names, topics, list of files), and the tree against rules:
//! dependencies between crates, forbidden names in algorithms, lengths of files.

#[path = "architecture/circles.rs"]
mod circles;
#[path = "architecture/files.rs"]
mod files;
#[path = "architecture/source.rs"]
mod source;

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::{Context, ensure};
use messages::{Delivery, MONITORS, TOPICS};

use crate::circles::{Graph, circles, modules};
use crate::source::{lines_of_code, tokens, without_tests};

/// The algorithm crates, and the crates of this workspace on which each may depend. `autopilot` is an exception for its link.
const ALGORITHMS: [(&str, &[&str]); 10] = [
    ("geometry", &[]),
    ("imaging", &[]),
    ("messages", &["geometry", "imaging"]),
    ("markers", &[]),
    ("fiducial", &["geometry", "imaging", "markers"]),
    ("calibration", &["geometry"]),
    ("landing", &["geometry"]),
    ("metering", &["imaging", "messages"]),
    ("rendering", &["geometry", "markers"]),
    ("world", &["autopilot", "geometry"]),
];
const AUTOPILOT: (&str, &[&str]) = ("autopilot", &["geometry"]);
const NODE: (&str, &[&str]) = ("node", &["messages"]);
/// The crates that cameras and detectors share.
const AIRLINK: (&str, &[&str]) = ("airlink", &["imaging", "messages", "node"]);
/// Files of users: images, videos, calibrations.
const MEDIA: (&str, &[&str]) = ("media", &["geometry", "imaging"]);
const SERVICES: [&str; 6] =
    ["camera-pub", "controller", "dashboard", "detector", "gcs-bridge", "recorder"];
/// The format of recordings.
const FLIGHTLOG: (&str, &[&str]) = ("flightlog", &["autopilot", "messages"]);
/// Answers over HTTP.
const WEB: (&str, &[&str]) = ("web", &["node"]);
/// The crates on which a service or a tool may depend.
const ROOMS: [&str; 14] = [
    "airlink",
    "autopilot",
    "calibration",
    "fiducial",
    "flightlog",
    "geometry",
    "imaging",
    "landing",
    "markers",
    "media",
    "messages",
    "metering",
    "node",
    "web",
];
/// Further crates on which a tool may depend: pictures and worlds with truth, which also the tests of any room may use.
const TRUTH: [&str; 2] = ["rendering", "world"];
/// The crates on which only tests may depend.
const TESTING: &str = "testing";
/// The tests of the complete system.
const TESTS: &str = "tests";
/// The fuzz targets: they call all parsers of external data.
const FUZZ: &str = "fuzz";
/// The tools that stand above others: they call their pure parts in lock-step, or with recorded data; the tests of
/// replay and report take flights of the experiments.
const ABOVE: [(&str, &[&str]); 3] = [
    ("experiments", &["controller", "detector", "simulator"]),
    ("replay", &["controller", "detector", "experiments"]),
    ("report", &["controller", "experiments", "replay"]),
];
/// Further crates on which the program may depend, besides services and tools: markers to find in files and to print, and the network.
const ALIGHT: [&str; 9] = [
    "calibration",
    "fiducial",
    "flightlog",
    "geometry",
    "imaging",
    "markers",
    "media",
    "messages",
    "node",
];

/// Crates of algorithms but for these modules, which have the threads, the clock and the network.
const WITH_THREADS: [(&str, &[&str]); 2] =
    [("autopilot", &["connect", "link", "newest", "peers", "key_file"]), ("airlink", &["sender"])];

/// Names that an algorithm must not use.
const OUTSIDE: [&str; 17] = [
    "std::env",
    "std::fs",
    "std::io",
    "std::net",
    "std::process",
    "std::thread",
    "std::{",
    "Instant",
    "SystemTime",
    "tokio",
    "tracing",
    "log::",
    "println!",
    "eprintln!",
    "print!",
    "dbg!",
    "rustix",
];

/// The crates whose results a replay compares to the bit, and the lint that forbids them functions whose results differ between machines.
const SAME_EVERYWHERE: [&str; 5] = ["geometry", "messages", "autopilot", "landing", "controller"];
const SAME_LINT: &str = "#![cfg_attr(not(test), deny(clippy::disallowed_methods))]";

/// Maximum number of lines of code in one source file, comments and tests aside.
const MAX_LINES: usize = 700;

/// Maximum number of functions of which a parameter is a tuple: two or three of a type are clearer with names.
const MAX_TUPLES: usize = 4;

/// The file that publishes a recording again.
const PLAYER: &str = "alight/src/replay/live.rs";

/// Paths in documents that a command makes.
const EXAMPLES: [&str; 1] = ["seen/"];

/// Keys that share the comment of the key above them.
const SHARED_COMMENTS: [(&str, &str); 3] =
    [("simulator.toml", "east_m"), ("simulator.toml", "height"), ("simulator.toml", "focal_px")];

/// A package of the workspace.
struct Package {
    name: String,
    folder: PathBuf,
    /// Names of the libraries and, where there is none, of the programs it builds.
    targets: Vec<String>,
    /// Its dependencies, those of tests included, except the pictures of tests.
    dependencies: BTreeSet<String>,
    /// All its dependencies: of itself, its tests, benches and examples.
    all_dependencies: BTreeSet<String>,
}

impl Package {
    fn is_tool(&self) -> bool {
        self.folder.parent().is_some_and(|parent| parent.ends_with("tools"))
    }

    /// Its source files.
    fn sources(&self) -> anyhow::Result<Vec<PathBuf>> {
        let mut folders = vec![self.folder.join("src")];
        folders.retain(|folder| folder.is_dir());
        let mut files = Vec::new();
        while let Some(folder) = folders.pop() {
            for entry in std::fs::read_dir(&folder).with_context(|| format!("{folder:?}"))? {
                let path = entry?.path();
                match path.extension() {
                    _ if path.is_dir() => folders.push(path),
                    Some(extension) if extension == "rs" => files.push(path),
                    _ => {}
                }
            }
        }
        Ok(files)
    }
}

fn root() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("..")
}

fn text(path: impl AsRef<Path>) -> anyhow::Result<String> {
    let path = path.as_ref();
    std::fs::read_to_string(path).with_context(|| format!("reading {path:?}"))
}

/// The files of the repository whose names end so, by their paths from its root; without git, a skip and none.
fn tracked(extension: &str) -> anyhow::Result<Vec<String>> {
    // Those that are not committed yet count as well.
    let listing = ["ls-files", "--cached", "--others", "--exclude-standard"];
    let listing = Command::new("git").args(listing).current_dir(root()).output();
    let Some(listing) = listing.ok().filter(|output| output.status.success()) else {
        testing::skip("git", "this is no git repository, or git is missing");
        return Ok(Vec::new());
    };
    let files = String::from_utf8(listing.stdout)?;
    ensure!(files.lines().count() > 100, "only {} files are tracked", files.lines().count());
    let is_wanted = |file: &&str| {
        let end = file.rsplit('.').next().unwrap_or_default();
        // A file may have been removed and not yet committed.
        (extension.is_empty() || end == extension) && root().join(file).is_file()
    };
    Ok(files.lines().filter(is_wanted).map(str::to_owned).collect())
}

fn workspace() -> anyhow::Result<Vec<Package>> {
    let output = Command::new(env!("CARGO"))
        .args(["metadata", "--no-deps", "--format-version", "1", "--offline"])
        .current_dir(root())
        .output()?;
    ensure!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let metadata: serde_json::Value = serde_json::from_slice(&output.stdout)?;
    let packages = metadata["packages"].as_array().context("packages")?;
    let strings = |list: &serde_json::Value, key: &str| -> Vec<String> {
        let list = list.as_array().into_iter().flatten();
        list.filter_map(|entry| entry[key].as_str().map(str::to_owned)).collect()
    };
    let counts = |dependency: &&serde_json::Value| {
        dependency["kind"] != "dev"
            || TRUTH.iter().chain([&TESTING]).all(|name| dependency["name"] != *name)
    };
    packages
        .iter()
        .map(|package| {
            let manifest = Path::new(package["manifest_path"].as_str().context("manifest_path")?);
            let targets = package["targets"].as_array().context("targets")?;
            let dependencies = package["dependencies"].as_array().context("dependencies")?;
            let all = serde_json::Value::Array(dependencies.clone());
            let dependencies = dependencies.iter().filter(counts).cloned().collect();
            let main = |target: &&serde_json::Value| target["kind"][0] == "lib";
            let library = targets.iter().filter(main).cloned().collect::<Vec<_>>();
            let programs = targets.iter().filter(|target| target["kind"][0] == "bin").cloned();
            let main = if library.is_empty() { programs.collect() } else { library };
            Ok(Package {
                name: package["name"].as_str().context("name")?.to_owned(),
                folder: manifest.parent().context("folder")?.to_owned(),
                targets: strings(&serde_json::Value::Array(main), "name"),
                dependencies: strings(&serde_json::Value::Array(dependencies), "name")
                    .into_iter()
                    .collect(),
                all_dependencies: strings(&all, "name").into_iter().collect(),
            })
        })
        .collect()
}

fn package<'a>(workspace: &'a [Package], name: &str) -> anyhow::Result<&'a Package> {
    workspace.iter().find(|p| p.name == name).with_context(|| format!("there is no package {name}"))
}

/// The code in a file: without comments, and without the tests at its end.
fn code(path: &Path) -> anyhow::Result<String> {
    let source = text(path)?;
    let (code, tests) = source.split_once("\n#[cfg(test)]\nmod ").unwrap_or((&source, ""));
    // The module's end is the first brace at the beginning of a line.
    let after = tests.split_once("\n}\n").map_or("", |(_, after)| after);
    ensure!(after.trim().is_empty(), "{path:?}: code after the tests, which come last");
    let without_comment = |line: &str| line.split("//").next().unwrap_or_default().to_owned();
    Ok(code.lines().map(without_comment).collect::<Vec<_>>().join("\n"))
}

#[test]
fn folders_packages_and_libraries_share_a_name() -> anyhow::Result<()> {
    for package in workspace()?.into_iter().filter(|package| package.name != TESTS) {
        let Package { name, folder, targets, .. } = package;
        ensure!(folder.ends_with(&name), "the package {name} is in {folder:?}");
        ensure!(targets == [name.replace('-', "_")], "the package {name} builds {targets:?}");
    }
    Ok(())
}

#[test]
fn dependencies_point_downwards_only() -> anyhow::Result<()> {
    let workspace = workspace()?;
    let names: BTreeSet<&str> = workspace.iter().map(|p| p.name.as_str()).collect();
    let crates: BTreeMap<_, _> =
        ALGORITHMS.into_iter().chain([AUTOPILOT, NODE, AIRLINK, MEDIA, FLIGHTLOG, WEB]).collect();
    for package in &workspace {
        let allowed: BTreeSet<&str> = match crates.get(package.name.as_str()) {
            Some(allowed) => allowed.iter().copied().collect(),
            None if [TESTS, FUZZ].contains(&package.name.as_str()) => continue,
            None if package.name == TESTING => BTreeSet::new(),
            None if package.name == "alight" => {
                let tools = workspace.iter().filter(|p| p.is_tool()).map(|p| p.name.as_str());
                ALIGHT.into_iter().chain(SERVICES).chain(tools).collect()
            }
            None => {
                let is_known = package.is_tool() || SERVICES.contains(&package.name.as_str());
                ensure!(is_known, "{}: name its allowed dependencies in this test", package.name);
                let truth = TRUTH.into_iter().filter(|_| package.is_tool());
                let below = ABOVE.into_iter().filter(|(above, _)| package.name == *above);
                let below = below.flat_map(|(_, below)| below.iter().copied());
                ROOMS.into_iter().chain(truth).chain(below).collect()
            }
        };
        for dependency in package.dependencies.iter().filter(|d| names.contains(d.as_str())) {
            let is_allowed = allowed.contains(dependency.as_str());
            ensure!(is_allowed, "{} must not depend on {dependency}", package.name);
        }
    }
    Ok(())
}

#[test]
fn no_crates_need_each_other() -> anyhow::Result<()> {
    let workspace = workspace()?;
    let names: BTreeSet<String> = workspace.iter().map(|package| package.name.clone()).collect();
    let needs =
        |package: &Package| package.all_dependencies.intersection(&names).cloned().collect();
    let graph: Graph = workspace.iter().map(|p| (p.name.clone(), needs(p))).collect();
    let found = circles(&graph);
    ensure!(found.is_empty(), "crates need each other: {found:?}");
    Ok(())
}

#[test]
fn no_modules_of_a_crate_need_each_other() -> anyhow::Result<()> {
    for package in workspace()? {
        let src = package.folder.join("src");
        let graph = modules(&src, &package.sources()?)?;
        let found = circles(&graph);
        ensure!(found.is_empty(), "in {} these need each other: {found:?}", package.name);
    }
    Ok(())
}

#[test]
fn no_source_file_is_long() -> anyhow::Result<()> {
    let mut long = Vec::new();
    for package in workspace()? {
        for path in package.sources()? {
            let lines = lines_of_code(&text(&path)?);
            long.extend((lines > MAX_LINES).then(|| format!("{path:?}: {lines} lines of code")));
        }
    }
    ensure!(long.is_empty(), "more than {MAX_LINES}: {long:#?}");
    Ok(())
}

#[test]
fn bounds_are_named_min_and_max() -> anyhow::Result<()> {
    let mut found = BTreeSet::new();
    for path in tracked("rs")?.into_iter().chain(tracked("toml")?) {
        let content = text(root().join(&path))?;
        let is_code = path.ends_with(".rs");
        let code = if is_code { without_tests(&content) } else { content };
        for name in tokens(&code) {
            let upper = name.split('_').any(|part| part == "MOST" || part == "LEAST");
            let lower = name.starts_with("most_") || name.starts_with("least_");
            // Comments, which contain "at most", are not checked.
            let bare = is_code && (name == "most" || name == "least");
            let is_private = upper || bare || lower && !name.starts_with("least_squares");
            found.extend(is_private.then(|| format!("{path}: {name}")));
        }
    }
    ensure!(found.is_empty(), "say MIN or MAX: {found:#?}");
    Ok(())
}

/// Words that describe programs and values as persons, and the files that explain that.
const PERSONAL: [&str; 4] = ["told", "tell", "tells", "heard"];
const ABOUT_WORDS: [&str; 2] = ["CONTRIBUTING.md", "tests/architecture.rs"];

#[test]
fn programs_and_values_are_not_described_as_persons() -> anyhow::Result<()> {
    let mut found = BTreeSet::new();
    for ending in ["rs", "toml", "py", "js", "html", "md"] {
        for path in tracked(ending)?.into_iter().filter(|it| !ABOUT_WORDS.contains(&it.as_str())) {
            let content = text(root().join(&path))?.to_lowercase();
            let words = content.split(|letter: char| !letter.is_alphabetic());
            found.extend(
                words.filter(|word| PERSONAL.contains(word)).map(|word| format!("{path}: {word}")),
            );
        }
    }
    ensure!(found.is_empty(), "CONTRIBUTING.md names words to use instead: {found:#?}");
    Ok(())
}

#[test]
fn parameters_are_no_tuples() -> anyhow::Result<()> {
    let mut found = Vec::new();
    for package in workspace()? {
        for path in package.sources()? {
            let code = without_tests(&text(&path)?);
            found.extend(with_tuples(&code).into_iter().map(|name| format!("{path:?}: {name}")));
        }
    }
    ensure!(found.len() <= MAX_TUPLES, "{} functions take tuples: {found:#?}", found.len());
    Ok(())
}

/// The functions of which a parameter is a tuple, a reference to one, or a list of some.
fn with_tuples(code: &str) -> Vec<String> {
    let tokens = tokens(code);
    let mut found = Vec::new();
    for (at, _) in tokens.iter().enumerate().filter(|(_, token)| **token == "fn") {
        let rest = &tokens[at + 1..];
        // After the name and its generic parameters.
        let Some(open) = rest.iter().position(|token| *token == "(") else { continue };
        let mut depth = 0;
        let mut before = "";
        for (at, token) in rest.iter().enumerate().skip(open) {
            let list = &rest[at..];
            depth += usize::from(*token == "(");
            let opens = ["(", ":", "&", "[", "<", "mut"].contains(&before) && depth > 1;
            if *token == "(" && opens && list.get(1) != Some(&")") && has_comma(list) {
                found.extend(rest.first().map(|name| (*name).to_owned()));
                break;
            }
            depth -= usize::from(*token == ")");
            if depth == 0 {
                break;
            }
            before = token;
        }
    }
    found
}

/// Whether there is a comma directly in the brackets at the beginning.
fn has_comma(tokens: &[&str]) -> bool {
    let mut depth = 0;
    for token in tokens {
        match *token {
            "(" | "[" | "<" | "{" => depth += 1,
            ")" | "]" | ">" | "}" => depth -= 1,
            "," if depth == 1 => return true,
            _ => {}
        }
        if depth == 0 {
            return false;
        }
    }
    false
}

#[test]
fn only_node_uses_zenoh_and_only_autopilot_uses_mavlink() -> anyhow::Result<()> {
    for (protocol, room) in [("zenoh", "node"), ("mavlink", "autopilot")] {
        for package in workspace()? {
            let knows = package.dependencies.iter().any(|name| name.starts_with(protocol));
            ensure!(knows == (package.name == room), "{} and {protocol}: {knows}", package.name);
        }
    }
    Ok(())
}

#[test]
fn algorithms_use_no_clock_file_network_thread_or_log() -> anyhow::Result<()> {
    let workspace = workspace()?;
    let mut files = Vec::new();
    for (name, _) in ALGORITHMS {
        let package = package(&workspace, name)?;
        for outside in ["tokio", "tracing", "log", "rustix", "libc", "anyhow"] {
            ensure!(!package.dependencies.contains(outside), "{name} depends on {outside}");
        }
        files.extend(package.sources()?);
    }
    for (name, modules) in WITH_THREADS {
        let mut sources = package(&workspace, name)?.sources()?;
        sources.retain(|path| !modules.iter().any(|module| path.ends_with(format!("{module}.rs"))));
        for path in sources.iter().filter(|path| !path.ends_with("lib.rs")) {
            let code = code(path)?;
            for outside in modules.iter().map(|module| format!("crate::{module}")) {
                ensure!(!code.contains(&outside), "{path:?} mentions `{outside}`");
            }
            ensure!(!code.contains("node::"), "{path:?} mentions `node::`");
        }
        files.extend(sources);
    }
    ensure!(files.len() > 30, "only {} files are algorithms", files.len());
    for path in files {
        let code = code(&path)?;
        for outside in OUTSIDE {
            ensure!(!code.contains(outside), "{path:?} mentions `{outside}`");
        }
    }
    Ok(())
}

#[test]
fn no_service_depends_on_a_simulation() -> anyhow::Result<()> {
    let workspace = workspace()?;
    for service in SERVICES {
        for path in package(&workspace, service)?.sources()? {
            let code = code(&path)?;
            for truth in ["TRUTH", "WIND", "simulat"] {
                ensure!(!code.contains(truth), "{path:?} mentions `{truth}`");
            }
        }
    }
    Ok(())
}

#[test]
fn every_queue_has_a_bound() -> anyhow::Result<()> {
    for package in workspace()? {
        for path in package.sources()? {
            let code = code(&path)?;
            for unbounded in ["unbounded", "std::sync::mpsc"] {
                ensure!(!code.contains(unbounded), "{path:?} mentions `{unbounded}`");
            }
        }
    }
    Ok(())
}

#[test]
fn only_node_waits_on_a_thread() -> anyhow::Result<()> {
    for package in workspace()? {
        for path in package.sources()? {
            // A runtime's own loses wake-ups where Zenoh blocks the thread.
            ensure!(!code(&path)?.contains(".block_on("), "{path:?}: use `node::block_on`");
        }
    }
    Ok(())
}

/// The constants of the topic table: name and key.
fn topic_constants(workspace: &[Package]) -> anyhow::Result<Vec<(String, String)>> {
    let table = code(&package(workspace, "messages")?.folder.join("src/topic.rs"))?;
    let mut constants = Vec::new();
    for part in table.split("pub const ").skip(1) {
        let (name, rest) = part.split_once(": ").context("a constant")?;
        if rest.starts_with("Topic<") {
            let key = rest.split('"').nth(1).with_context(|| format!("the key of {name}"))?;
            constants.push((name.to_owned(), key.to_owned()));
        }
    }
    ensure!(constants.len() == TOPICS.len(), "{} constants of topics", constants.len());
    Ok(constants)
}

#[test]
fn a_topic_is_published_by_the_services_that_its_row_names() -> anyhow::Result<()> {
    let workspace = workspace()?;
    let constants = topic_constants(&workspace)?;
    let mut publishers: BTreeMap<(String, &str), BTreeSet<&str>> = BTreeMap::new();
    for package in workspace.iter().filter(|p| p.name != "node" && p.name != TESTS) {
        // A recording that is published again replaces its publishers.
        for path in package.sources()?.into_iter().filter(|path| !path.ends_with(PLAYER)) {
            let code: String = code(&path)?.split_whitespace().collect();
            for (name, key) in &constants {
                // A query's row names the requester, its reply's row the recipient.
                for (call, end) in [("publisher", ""), (".command", ""), (".commands", "_REPLY")] {
                    if code.contains(&format!("{call}(topic::{name},")) {
                        let row = (format!("{name}{end}"), key.as_str());
                        publishers.entry(row).or_default().insert(&package.name);
                    }
                }
            }
        }
    }
    // All that have a configuration are services of the network, and `node` publishes health and configuration of each;
    // the health of the relay as well, which has nothing to configure.
    let with_defaults = workspace.iter().filter(|p| defaults(p).is_file());
    let configured: BTreeSet<&str> = with_defaults.map(|p| p.name.as_str()).collect();
    let services = configured.iter().copied().chain(["relay"]).collect();
    publishers.insert(("HEALTH".to_owned(), "health/{service}/{instance}"), services);
    publishers.insert(("CONFIGURATION".to_owned(), "config/{service}/{instance}"), configured);
    for ((name, key), found) in &publishers {
        let replies = name.ends_with("_REPLY");
        let of_row =
            |row: &&messages::Row| row.key == *key && (row.message == "CommandReply") == replies;
        let row = TOPICS.iter().find(of_row).with_context(|| format!("a row of {name}"))?;
        let stated: BTreeSet<_> = row.publishers.iter().copied().collect();
        ensure!(stated == *found, "{key} is published by {found:?}, its row states {stated:?}");
    }
    ensure!(publishers.len() == TOPICS.len(), "rows without a publisher: only {publishers:#?}");
    Ok(())
}

#[test]
fn a_topic_is_subscribed_to_by_the_services_that_its_row_names() -> anyhow::Result<()> {
    let workspace = workspace()?;
    let constants = topic_constants(&workspace)?;
    let mut rows = 0;
    for (name, key) in &constants {
        let row = TOPICS.iter().find(|row| row.key == key).with_context(|| name.clone())?;
        let mut found: BTreeSet<&str> = BTreeSet::new();
        for package in workspace.iter().filter(|p| p.name != "node" && p.name != TESTS) {
            let calls = [format!("subscriber(topic::{name},"), format!("=>topic::{name},")];
            for path in package.sources()? {
                let code: String = code(&path)?.split_whitespace().collect();
                if !calls.iter().any(|call| code.contains(call)) {
                    continue;
                }
                match package.name.as_str() {
                    // The sender of the air link is a part of the publisher of frames.
                    "airlink" => found.extend(["camera-pub", "simulator"]),
                    // `alight up` watches with the key of the service that it supervises. Healths are read only where that key may read them.
                    "alight" if path.ends_with("peers.rs") && name != "HEALTH" => {
                        found.extend(["controller", "detector"]);
                    }
                    other => drop(found.insert(other)),
                }
            }
        }
        found.retain(|service| !MONITORS.contains(service));
        let stated: BTreeSet<_> = row.subscribers.iter().copied().collect();
        ensure!(stated == found, "{key} is subscribed to by {found:?}, its row states {stated:?}");
        rows += usize::from(!found.is_empty());
    }
    ensure!(rows > 10, "only {rows} topics have subscribers");
    Ok(())
}

fn defaults(package: &Package) -> PathBuf {
    package.folder.join(format!("{}.toml", package.name))
}

#[test]
fn every_key_of_a_default_configuration_is_explained() -> anyhow::Result<()> {
    let workspace = workspace()?;
    let mut shared = BTreeSet::new();
    let mut services = 0;
    for package in &workspace {
        let mut configured = false;
        for path in package.sources()? {
            let code = code(&path)?;
            configured |= package.name != "node" && code.contains("const DEFAULTS: &'static str");
        }
        if !configured {
            continue;
        }
        services += 1;
        let file = format!("{}.toml", package.name);
        let defaults = text(defaults(package))?;
        let mut above = "";
        for line in defaults.lines() {
            let is_key = line.starts_with(|first: char| first.is_ascii_alphabetic());
            if is_key && !above.starts_with('#') {
                let key = line.split_whitespace().next().unwrap_or_default();
                let exception = SHARED_COMMENTS.iter().find(|it| **it == (file.as_str(), key));
                shared.insert(exception.with_context(|| format!("{file}: no comment on {key}"))?);
            }
            above = line;
        }
    }
    ensure!(services > SERVICES.len(), "only {services} packages have a configuration");
    ensure!(shared.len() == SHARED_COMMENTS.len(), "unused exceptions: only {shared:?} are");
    Ok(())
}

/// The texts in backticks of a Markdown text, outside of its code blocks.
fn quoted(markdown: &str) -> Vec<&str> {
    let prose = markdown.split("```").step_by(2);
    prose.flat_map(|part| part.split('`').skip(1).step_by(2)).collect()
}

fn is_topic(key: &str) -> bool {
    key == "alive/{service}/{instance}" || TOPICS.iter().any(|row| row.key == key)
}

/// True when a file defines something of this name.
fn defines(code: &str, name: &str) -> bool {
    let ends = |rest: &str| !rest.starts_with(|c: char| c.is_alphanumeric() || c == '_');
    ["fn", "struct", "enum", "trait", "const", "mod", "type"].iter().any(|kind| {
        let definition = format!("{kind} {name}");
        code.match_indices(&definition).any(|(at, found)| ends(&code[at + found.len()..]))
    })
}

#[test]
fn documents_name_only_existing_items() -> anyhow::Result<()> {
    let mut wrong = Vec::new();
    let extensions = [".rs", ".toml", ".md", ".json5", ".py"];
    let mut names = 0;
    for document in tracked("md")? {
        let markdown = text(root().join(&document))?;
        // The list of the files is compared with the files themselves.
        let markdown = markdown.split("\n## The files\n").next().unwrap_or_default();
        for quote in quoted(markdown) {
            ensure!(!quote.contains('\n'), "{document}: `{quote}` goes over two lines");
            let (path, name) = match quote.split_once(": ") {
                Some((path, name)) => (path, Some(name)),
                None => (quote, None),
            };
            let is_path = path.contains('/') || extensions.iter().any(|end| path.ends_with(end));
            if !is_path
                || path.starts_with('/')
                || path.contains(|c: char| c.is_whitespace() || ":{<*$".contains(c))
            {
                let is_key = path.contains('/') && path.contains('{') && !path.contains(' ');
                if is_key && !is_topic(path) {
                    wrong.push(format!("{document}: there is no topic `{path}`"));
                }
                continue;
            }
            let next_to_it = root().join(&document).with_file_name(path);
            let file = if next_to_it.exists() { next_to_it } else { root().join(path) };
            if !file.exists() && !is_topic(path) && !EXAMPLES.contains(&path) {
                wrong.push(format!("{document}: there is no `{path}`"));
            } else if let Some(name) = name {
                let last = name.rsplit("::").next().unwrap_or(name);
                if !defines(&text(&file)?, last) {
                    wrong.push(format!("{document}: no `{name}` in `{path}`"));
                }
                names += 1;
            }
        }
    }
    ensure!(wrong.is_empty(), "{wrong:#?}");
    ensure!(names > 30, "only {names} names of functions were found");
    Ok(())
}

#[test]
fn decisions_are_the_same_on_every_machine() -> anyhow::Result<()> {
    let workspace = workspace()?;
    for name in SAME_EVERYWHERE {
        let library = package(&workspace, name)?.folder.join("src/lib.rs");
        ensure!(text(&library)?.contains(SAME_LINT), "{library:?} lacks {SAME_LINT}");
    }
    let lint = text(root().join("clippy.toml"))?;
    for function in ["sin", "atan2", "exp", "hypot", "powi", "max"] {
        for float in ["f64", "f32"] {
            let entry = format!("\"{float}::{function}\"");
            ensure!(lint.contains(&entry), "clippy.toml no longer forbids {entry}");
        }
    }
    // Kernels of matrix products that are chosen when the program runs, for matrices of dynamic size.
    let lock = text(root().join("Cargo.lock"))?;
    ensure!(!lock.contains("\"matrixmultiply\""), "matrixmultiply is back: nalgebra has `std`");
    let manifest = text(root().join("Cargo.toml"))?;
    let nalgebra = manifest.lines().find(|line| line.starts_with("nalgebra = "));
    let nalgebra = nalgebra.context("nalgebra is no dependency any more")?;
    ensure!(nalgebra.contains("\"libm-force\""), "without `libm-force`: {nalgebra}");
    Ok(())
}

#[test]
fn the_architecture_has_the_topic_table() -> anyhow::Result<()> {
    let markdown = text(root().join("ARCHITECTURE.md"))?;
    let is_row = |line: &&str| quoted(line).first().copied().is_some_and(is_topic);
    let table: Vec<&str> =
        markdown.lines().filter(|line| line.starts_with("| `")).filter(is_row).collect();
    for row in TOPICS {
        let delivery = match row.delivery {
            Delivery::Latest => "latest",
            Delivery::LatestPriority => "latest, priority",
            Delivery::LastValue => "last value",
            Delivery::Reliable => "reliable",
            Delivery::Record => "record",
            Delivery::Query => "query",
        };
        let publishers = row.publishers.join(", ");
        let subscribers = row.subscribers.join(", ");
        let line = format!(
            "| `{}` | {} v{} | {delivery} | {publishers} | {subscribers} |",
            row.key, row.message, row.version
        )
        .replace("|  |", "| |");
        ensure!(table.contains(&line.as_str()), "ARCHITECTURE.md lacks the row\n{line}");
    }
    ensure!(table.len() == TOPICS.len() + 1, "rows without a topic in {table:#?}");
    Ok(())
}

/// `UPDATE_EXPECT=1 cargo test -p tests --test architecture` writes the list again.
#[test]
fn the_architecture_lists_every_source_file() -> anyhow::Result<()> {
    let path = root().join("ARCHITECTURE.md");
    let markdown = text(&path)?;
    let (before, list) = markdown.split_once("\n## The files\n").context("no list of the files")?;
    let files = tracked("rs")?;
    if files.is_empty() {
        return Ok(());
    }
    let (introduction, list) =
        list.split_once("\n### ").context("no room in the list of the files")?;
    let expected = files::list(files.iter().map(Path::new), |file| text(root().join(file)))?;
    if std::env::var_os("UPDATE_EXPECT").is_some() {
        return Ok(std::fs::write(
            path,
            format!("{before}\n## The files\n{introduction}\n{expected}"),
        )?);
    }
    let list = format!("### {list}");
    let lacking = expected.lines().find(|line| !list.lines().any(|listed| listed == *line));
    ensure!(
        lacking.is_none(),
        "ARCHITECTURE.md lacks (UPDATE_EXPECT=1 adds it) the line\n{}",
        lacking.unwrap_or_default()
    );
    ensure!(
        list == expected,
        "ARCHITECTURE.md lists files that are not there, or in another order"
    );
    Ok(())
}

#[test]
fn no_file_names_a_folder_of_a_developers_machine() -> anyhow::Result<()> {
    let folders = ["home", "root", "tmp", "Users", "work"].map(|name| format!("/{name}/"));
    for file in tracked("")? {
        let bytes = std::fs::read(root().join(&file))?;
        let content = String::from_utf8_lossy(&bytes);
        for folder in &folders {
            let found = content.match_indices(folder.as_str()).find(|(at, _)| {
                !content[..*at].ends_with(|c: char| c.is_alphanumeric() || "._-/~)}".contains(c))
            });
            ensure!(found.is_none(), "{file} names {folder}, a folder of some machine");
        }
    }
    Ok(())
}
