//! Ctrl-C while there is something to keep: the first asks the work to end, the second ends the process.

use std::process::ExitCode;

use anyhow::Context;
use tokio::runtime::Runtime;
use tokio::signal::unix::{Signal, SignalKind, signal};
use tokio::sync::watch;

use crate::terminal::write_error;

/// What shells add to a signal's number for the exit status of a process that it ended.
const BY_SIGNAL: u8 = 128;
const INTERRUPT: u8 = 2;
const TERMINATE: u8 = 15;

/// What is kept of flights in lock-step.
pub(crate) const FLIGHTS_END: &str =
    "the flights under way end, and those that were flown are kept";

/// Whether this process was interrupted.
pub(crate) struct Interruption {
    signal: watch::Receiver<Option<u8>>,
    /// Ends with this.
    _runtime: Runtime,
}

impl Interruption {
    /// By SIGINT (Ctrl-C) or SIGTERM. `what_is_kept` is told at the first; a second one ends the process at once.
    ///
    /// # Errors
    /// When the signals cannot be listened to.
    pub(crate) fn on_signals(what_is_kept: &'static str) -> anyhow::Result<Self> {
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(1)
            .enable_all()
            .build()
            .context("starting the runtime that listens to Ctrl-C")?;
        let (sender, receiver) = watch::channel(None);
        let (mut interrupts, mut terminations) = {
            let _in_it = runtime.enter();
            let listening = "listening to Ctrl-C";
            (
                signal(SignalKind::interrupt()).context(listening)?,
                signal(SignalKind::terminate()).context(listening)?,
            )
        };
        runtime.spawn(async move {
            let number = next(&mut interrupts, &mut terminations).await;
            write_error(&format!("interrupted: {what_is_kept}; Ctrl-C again ends it at once"));
            sender.send_replace(Some(number));
            let number = next(&mut interrupts, &mut terminations).await;
            std::process::exit(i32::from(BY_SIGNAL + number));
        });
        Ok(Self { signal: receiver, _runtime: runtime })
    }

    /// Whether it was.
    pub(crate) fn is_requested(&self) -> bool {
        self.signal.borrow().is_some()
    }

    /// Returns once it is.
    pub(crate) async fn requested(&self) {
        let mut signal = self.signal.clone();
        if signal.wait_for(Option::is_some).await.is_err() {
            // Nobody listens any more: nobody will ask.
            std::future::pending::<()>().await;
        }
    }

    /// The exit status of work that was cut short: that of a process which the signal ended.
    pub(crate) fn exit_code(&self) -> ExitCode {
        let number = self.signal.borrow().unwrap_or(INTERRUPT);
        ExitCode::from(BY_SIGNAL + number)
    }
}

async fn next(interrupts: &mut Signal, terminations: &mut Signal) -> u8 {
    tokio::select! {
        _ = interrupts.recv() => INTERRUPT,
        _ = terminations.recv() => TERMINATE,
    }
}
