//! Runs the work of the camera on a thread that ends before its service does.

use std::thread::JoinHandle;

use anyhow::Context;
use node::Shutdown;
use tokio::sync::oneshot;

/// Runs work on a thread of its own until it ends, a shutdown is requested, or the returned future is dropped, so that decoding does
/// not block other tasks. The thread and all that its work owns have ended when this future has ended or is dropped: the
/// work uses the timers of the runtime, which may end then.
///
/// # Errors
/// The error of the work, or when the thread cannot be started.
pub(crate) async fn on_own_thread<W>(work: W, shutdown: Shutdown) -> anyhow::Result<()>
where
    W: AsyncFnOnce() -> anyhow::Result<()> + Send + 'static,
{
    let runtime = tokio::runtime::Handle::current();
    let (mut done, ended) = oneshot::channel();
    let body = move || {
        let result = node::block_on(&runtime, async {
            tokio::select! {
                // The end first: the work must not continue then.
                biased;
                // The service is gone: no task waits for the result.
                () = done.closed() => Ok(()),
                () = shutdown.requested() => Ok(()),
                result = work() => result,
            }
        });
        drop(done.send(result));
    };
    let thread = std::thread::Builder::new()
        .name("camera".to_owned())
        .spawn(body)
        .context("starting the camera's thread")?;
    let mut waiting = Waiting { ended: Some(ended), thread: Some(thread) };
    match &mut waiting.ended {
        Some(ended) => ended.await.context("the camera's thread ended without a result")?,
        None => Ok(()),
    }
}

/// Waits for the end of the thread when it is dropped.
struct Waiting {
    ended: Option<oneshot::Receiver<anyhow::Result<()>>>,
    thread: Option<JoinHandle<()>>,
}

impl Drop for Waiting {
    fn drop(&mut self) {
        // Without a receiver the thread ends.
        drop(self.ended.take());
        // The result has reported a panic.
        if let Some(thread) = self.thread.take() {
            drop(thread.join());
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;
    use std::sync::atomic::{AtomicBool, Ordering};
    use std::time::Duration;

    use super::*;

    /// Takes a while to be dropped, as a camera that is closed.
    struct Slow(Arc<AtomicBool>);

    impl Drop for Slow {
        fn drop(&mut self) {
            std::thread::sleep(Duration::from_millis(300));
            self.0.store(true, Ordering::Relaxed);
        }
    }

    #[tokio::test]
    async fn what_the_thread_owns_is_closed_when_its_service_ends_or_is_dropped() {
        for is_endless in [false, true] {
            let is_closed = Arc::<AtomicBool>::default();
            let slow = Slow(Arc::clone(&is_closed));
            let (begun, begins) = oneshot::channel();
            let work = async move || {
                let _slow = &slow;
                begun.send(()).unwrap();
                match is_endless {
                    true => std::future::pending().await,
                    false => Ok(()),
                }
            };
            let service = on_own_thread(work, Shutdown::on_signals().unwrap());
            tokio::select! {
                ended = service => ended.unwrap(),
                () = async {
                    begins.await.unwrap();
                    if !is_endless {
                        std::future::pending::<()>().await;
                    }
                } => {}
            }
            assert!(is_closed.load(Ordering::Relaxed), "endless: {is_endless}");
        }
    }
}
