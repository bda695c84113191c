//! Waits for a future on the current thread, without or with a time limit.

use std::future::Future;
use std::pin::pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::task::{Context, Poll, Wake, Waker};
use std::thread::Thread;
use std::time::{Duration, Instant};

use tokio::runtime::Handle;

/// Runs a future to its end on this thread, with `runtime` for its timers, sockets and tasks.
///
/// Use this instead of the runtime's own `block_on` for all code that uses Zenoh. Some of Zenoh's calls block their thread with a
/// `block_on` of their own, and in Tokio both wait for the same flag of the thread: the inner one takes a wake-up that was meant for
/// the outer, and a future that is joined or selected there blocks. Here each has its own.
pub fn block_on<F: Future>(runtime: &Handle, future: F) -> F::Output {
    // Entered first, so that the future is dropped inside the runtime.
    let _entered = runtime.enter();
    let mut future = pin!(future);
    let flag = Flag::of_this_thread();
    let waker = Waker::from(Arc::clone(&flag));
    let mut context = Context::from_waker(&waker);
    loop {
        if let Poll::Ready(output) = future.as_mut().poll(&mut context) {
            return output;
        }
        // Parking ends also for other reasons, and others that park on this thread may take its token; the flag stays.
        while !flag.take() {
            std::thread::park();
        }
    }
}

/// Runs a future as [`block_on`] does, for at most `limit`; `None` when it has not ended by then, and is dropped.
///
/// The time is that of this thread. A thread that may outlive its runtime must use this instead of Tokio's timers: they panic once
/// the runtime is shut down.
pub fn block_on_for<F: Future>(runtime: &Handle, limit: Duration, future: F) -> Option<F::Output> {
    let began = Instant::now();
    let _entered = runtime.enter();
    let mut future = pin!(future);
    let flag = Flag::of_this_thread();
    let waker = Waker::from(Arc::clone(&flag));
    let mut context = Context::from_waker(&waker);
    loop {
        if let Poll::Ready(output) = future.as_mut().poll(&mut context) {
            return Some(output);
        }
        // Also of a future that is woken again and again.
        loop {
            let left = limit.checked_sub(began.elapsed()).filter(|left| !left.is_zero())?;
            if flag.take() {
                break;
            }
            std::thread::park_timeout(left);
        }
    }
}

/// Wakes a thread when its future can continue.
struct Flag {
    thread: Thread,
    is_woken: AtomicBool,
}

impl Flag {
    fn of_this_thread() -> Arc<Self> {
        Arc::new(Self { thread: std::thread::current(), is_woken: AtomicBool::new(false) })
    }

    /// Whether its future was woken since the last call.
    fn take(&self) -> bool {
        self.is_woken.swap(false, Ordering::Acquire)
    }
}

impl Wake for Flag {
    fn wake(self: Arc<Self>) {
        self.wake_by_ref();
    }

    fn wake_by_ref(self: &Arc<Self>) {
        if !self.is_woken.swap(true, Ordering::Release) {
            self.thread.unpark();
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::AtomicU32;
    use std::sync::mpsc::RecvTimeoutError;
    use std::time::Duration;

    use tokio::sync::Notify;
    use tokio::task::block_in_place;

    use super::*;

    /// One future waits for another that, once it has woken it, blocks the thread as Zenoh does.
    async fn woken_while_another_blocks() {
        let wake = Notify::new();
        let waits = wake.notified();
        let blocks = async {
            block_in_place(|| {
                Handle::current().block_on(async {
                    wake.notify_waiters();
                    tokio::time::sleep(Duration::from_millis(20)).await;
                });
            });
        };
        // In this order: the first is polled, and waits, before the second blocks.
        tokio::join!(biased; waits, blocks);
    }

    #[test]
    fn a_wake_up_while_another_future_blocks_the_thread_is_kept() {
        let (ended, end) = std::sync::mpsc::channel();
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(1)
            .enable_all()
            .build()
            .unwrap();
        std::thread::spawn(move || {
            block_on(runtime.handle(), woken_while_another_blocks());
            ended.send(()).unwrap();
        });
        assert_ne!(end.recv_timeout(Duration::from_secs(20)), Err(RecvTimeoutError::Timeout));
    }

    #[test]
    fn timers_tasks_and_tokens_that_others_left_are_no_trouble() {
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(1)
            .enable_all()
            .build()
            .unwrap();
        let polls = AtomicU32::new(0);
        std::thread::current().unpark();
        let output = block_on(runtime.handle(), async {
            let mut sleep = pin!(tokio::time::sleep(Duration::from_millis(30)));
            std::future::poll_fn(|context| {
                polls.fetch_add(1, Ordering::Relaxed);
                sleep.as_mut().poll(context)
            })
            .await;
            tokio::spawn(async { 7 }).await.unwrap()
        });
        assert_eq!(output, 7);
        assert_eq!(polls.into_inner(), 2, "polled without a wake-up");
    }
}
