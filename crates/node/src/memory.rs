//! Checks whether a session can have shared memory.

use rustix::fs::statvfs;
use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};

/// The memory that a session with shared memory must be able to lock as it opens, in bytes. Zenoh 1.10.2 locks 1.3 MB, and panics when it
/// cannot.
const MIN_BYTES: u64 = 2 << 20;
/// The system's folder of shared memory.
const FOLDER: &str = "/dev/shm";

/// The reason why this process cannot share memory, if it cannot. Its memlock limit is raised as far as it may.
pub(crate) fn lack_of_shared_memory() -> Option<String> {
    let Rlimit { maximum, .. } = getrlimit(Resource::Memlock);
    // If this is refused, the limit does not change.
    let _ = setrlimit(Resource::Memlock, Rlimit { current: maximum, maximum });
    let limit = getrlimit(Resource::Memlock).current;
    if let Some(limit) = limit.filter(|limit| *limit < MIN_BYTES) {
        return Some(format!(
            "the memlock limit is {} kB, less than {} kB: set LimitMEMLOCK=infinity in the systemd unit, `--ulimit memlock=-1` for a container, or `memlock` in /etc/security/limits.conf",
            limit >> 10,
            MIN_BYTES >> 10
        ));
    }
    let about = match statvfs(FOLDER) {
        Ok(about) => about,
        Err(problem) => return Some(format!("{FOLDER}: {problem}")),
    };
    let free = about.f_bavail.saturating_mul(about.f_frsize);
    // A file system without a bound has no blocks.
    (about.f_blocks > 0 && free < MIN_BYTES).then(|| {
        format!(
            "{FOLDER} has {} kB free, less than {} kB: remove files in it, or give a container more (`--shm-size`)",
            free >> 10,
            MIN_BYTES >> 10
        )
    })
}
