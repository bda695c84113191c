//! libFuzzer's program: fuzzes the target that `FUZZ_TARGET` names. `fuzz/run` builds and starts it.
#![no_main]
#![allow(
    unsafe_code,
    missing_docs,
    unreachable_pub,
    reason = "libFuzzer's macro expands to such code"
)]

use std::collections::BTreeSet;
use std::sync::{Mutex, OnceLock, PoisonError};

use fuzz::{TARGETS, Target, target};

static TARGET: OnceLock<Target> = OnceLock::new();
/// Where panics began.
static PANICS: Mutex<BTreeSet<String>> = Mutex::new(BTreeSet::new());

#[expect(clippy::panic, reason = "libFuzzer has no other way to report why it does not begin")]
fn chosen() -> Target {
    // libFuzzer's own hook ends the process, also for panics that are caught, as those of foreign decoders are. A panic that
    // is not caught ends it nevertheless. Each position is printed once.
    std::panic::set_hook(Box::new(|panic| {
        let place = panic.location().map(ToString::to_string).unwrap_or_default();
        let is_ours = fuzz::is_of_this_workspace(&place);
        if PANICS.lock().unwrap_or_else(PoisonError::into_inner).insert(place) {
            eprintln!("{panic}");
        }
        if is_ours {
            std::process::abort();
        }
    }));
    let name = std::env::var("FUZZ_TARGET").unwrap_or_default();
    target(&name).unwrap_or_else(|| {
        let names = TARGETS.map(|target| target.name).join(", ");
        panic!("FUZZ_TARGET={name} is no target; there are {names}")
    })
}

libfuzzer_sys::fuzz_target!(|input: &[u8]| {
    (TARGET.get_or_init(chosen).read)(input);
});
