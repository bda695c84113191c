//! libFuzzer's program: fuzzes the target that `FUZZ_TARGET` names. `fuzz/run` builds and starts it.
#![no_main]
#![allow(unsafe_code, missing_docs, unreachable_pub, reason = "what libFuzzer's macro expands to")]

use std::sync::OnceLock;

use fuzz::{TARGETS, Target, target};

static TARGET: OnceLock<Target> = OnceLock::new();

#[expect(clippy::panic, reason = "libFuzzer has no other way to say why it does not begin")]
fn chosen() -> Target {
    let name = std::env::var("FUZZ_TARGET").unwrap_or_default();
    target(&name).unwrap_or_else(|| {
        let names = TARGETS.map(|target| target.name).join(", ");
        panic!("FUZZ_TARGET={name} is no target; there are {names}")
    })
}

libfuzzer_sys::fuzz_target!(|input: &[u8]| {
    (TARGET.get_or_init(chosen).read)(input);
});
