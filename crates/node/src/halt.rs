//! Halts Zenoh's threads before the process exits.
//!
//! Zenoh keeps its shared memory in static variables, which the exit destroys while its threads still run: also where a session is closed, as some
//! of their tasks belong to no session, and closing one has a time limit. A thread that receives a frame or returns one at that moment panics.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use tokio::runtime::Handle;
use zenoh_runtime::ZRuntime;

/// Zenoh's thread pools.
static POOLS: [ZRuntime; 5] =
    [ZRuntime::Net, ZRuntime::TX, ZRuntime::Application, ZRuntime::RX, ZRuntime::Acceptor];
/// Timeout until the threads have halted. The last task of a thread ends before.
const LIMIT: Duration = Duration::from_millis(500);
/// Interval at which it is checked whether they have.
const POLL: Duration = Duration::from_millis(1);

/// Whether this process has opened a session, which starts the threads.
static HAS_SESSION: AtomicBool = AtomicBool::new(false);

/// Notes that a session is opened.
pub(crate) fn session_opens() {
    HAS_SESSION.store(true, Ordering::Release);
}

/// Halts Zenoh's threads, if a session was opened. Call it last in `main`: no session works from then on.
pub fn halt_zenoh() {
    if !HAS_SESSION.load(Ordering::Acquire) {
        return;
    }
    let mut handles: Vec<&Handle> = Vec::new();
    for pool in &POOLS {
        let handle: &Handle = pool;
        // One pool may stand for several.
        if !handles.iter().any(|known| std::ptr::eq(*known, handle)) {
            handles.push(handle);
        }
    }
    if !halt(&handles, LIMIT) {
        tracing::debug!("Zenoh's threads are busy at the end of the process");
    }
}

/// Occupies all threads of these pools for good; whether that succeeded within the limit.
fn halt(pools: &[&Handle], limit: Duration) -> bool {
    let deadline = Instant::now() + limit;
    let halted = Arc::new(AtomicUsize::new(0));
    let mut threads = 0;
    for pool in pools {
        let workers = pool.metrics().num_workers();
        threads += workers;
        for _ in 0..workers {
            let halted = Arc::clone(&halted);
            pool.spawn(async move {
                halted.fetch_add(1, Ordering::Release);
                loop {
                    std::thread::park();
                }
            });
        }
    }
    while halted.load(Ordering::Acquire) < threads {
        if Instant::now() >= deadline {
            return false;
        }
        std::thread::sleep(POLL);
    }
    true
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::AtomicU64;

    use super::*;

    fn pool(threads: usize) -> tokio::runtime::Runtime {
        let mut builder = tokio::runtime::Builder::new_multi_thread();
        builder.worker_threads(threads).enable_all().build().unwrap()
    }

    #[test]
    fn no_task_runs_once_the_threads_are_halted() {
        let pools = [pool(3), pool(1)];
        let steps = Arc::new(AtomicU64::new(0));
        for pool in pools.iter().flat_map(|pool| [pool; 8]) {
            let steps = Arc::clone(&steps);
            pool.spawn(async move {
                loop {
                    steps.fetch_add(1, Ordering::Relaxed);
                    tokio::task::yield_now().await;
                }
            });
        }
        while steps.load(Ordering::Relaxed) < 1000 {
            std::thread::yield_now();
        }
        let handles: Vec<&Handle> = pools.iter().map(tokio::runtime::Runtime::handle).collect();
        assert!(halt(&handles, Duration::from_secs(60)));
        let before = steps.load(Ordering::Relaxed);
        std::thread::sleep(Duration::from_millis(50));
        assert_eq!(steps.load(Ordering::Relaxed), before);
        assert!(!halt(&handles, Duration::from_millis(20)), "they do nothing else");
        // Dropping them would wait for their threads.
        pools.into_iter().for_each(tokio::runtime::Runtime::shutdown_background);
    }
}
