//! Reads the corpus that fuzzing has found and stored, in every run of the tests.

use std::collections::BTreeSet;
use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Instant;

use anyhow::{Context, ensure};
use fuzz::{MAX_MEMORY_MB, MAX_TIME_S, TARGETS};

/// The most that the corpus may take in the repository, in bytes.
const MAX_CORPUS_BYTES: u64 = 200_000;

static OWN_PANICS: AtomicUsize = AtomicUsize::new(0);

#[test]
fn every_stored_input_is_read_without_a_panic_in_bounded_time_and_memory() -> anyhow::Result<()> {
    // The readers catch a decoder's panic, never one of their own.
    std::panic::set_hook(Box::new(|panic| {
        let place = panic.location().map(ToString::to_string).unwrap_or_default();
        eprintln!("{panic}");
        OWN_PANICS.fetch_add(usize::from(fuzz::is_of_this_workspace(&place)), Ordering::Relaxed);
    }));
    let corpus = Path::new(env!("CARGO_MANIFEST_DIR")).join("corpus");
    let mut bytes = 0;
    for target in TARGETS {
        let folder = corpus.join(target.name);
        let mut count = 0;
        for entry in std::fs::read_dir(&folder).with_context(|| format!("{folder:?}"))? {
            let path = entry?.path();
            let input = std::fs::read(&path)?;
            bytes += input.len() as u64;
            count += 1;
            let begun = Instant::now();
            let memory = allocation_counter::measure(|| (target.read)(&input));
            let took_s = begun.elapsed().as_secs_f64();
            ensure!(took_s < MAX_TIME_S as f64, "{path:?} took {took_s:.1} s");
            let used_mb = memory.bytes_max >> 20;
            ensure!(used_mb < MAX_MEMORY_MB, "{path:?} used {used_mb} MB");
        }
        ensure!(count > 0, "{folder:?} is empty");
        println!("{}: {count} inputs", target.name);
    }
    let own_panics = OWN_PANICS.load(Ordering::Relaxed);
    ensure!(own_panics == 0, "{own_panics} panics of this workspace");
    ensure!(bytes <= MAX_CORPUS_BYTES, "the corpus has {bytes} bytes");
    Ok(())
}

/// Mutations alone find no message whose type and version no input has.
#[test]
fn the_corpus_has_an_input_of_each_message_that_is_read_from_the_network() -> anyhow::Result<()> {
    let mut read = BTreeSet::new();
    for entry in std::fs::read_dir(Path::new(env!("CARGO_MANIFEST_DIR")).join("corpus/codec"))? {
        read.extend(fuzz::payloads::codec(&std::fs::read(entry?.path())?));
    }
    let messages = messages::TOPICS.iter().map(|row| row.message);
    // A tape has a reader of its own, which the target `recording` reaches.
    let missing: Vec<&str> = messages.filter(|it| !read.contains(it) && *it != "Tape").collect();
    ensure!(missing.is_empty(), "no input of {missing:?}");
    Ok(())
}
