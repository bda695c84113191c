//! Handles Ctrl-C, SIGTERM and SIGHUP during long work: the first signal asks the work to end and keep its results, the second one ends the
//! process.

use std::process::ExitCode;

use anyhow::Context;
use node::ignores_hangups;
use tokio::runtime::Runtime;
use tokio::signal::unix::{Signal, SignalKind, signal};
use tokio::sync::watch;

use crate::terminal::write_error;

/// Shells add this to a signal's number for the exit status of a process that it ended.
const BY_SIGNAL: u8 = 128;
const HANGUP: u8 = 1;
const INTERRUPT: u8 = 2;
const TERMINATE: u8 = 15;

/// The message at the interruption of flights in lock-step.
pub(crate) const FLIGHTS_END: &str =
    "the flights under way end, and those that were flown are kept";

/// The warning after a landing that was interrupted in the air.
pub(crate) const IN_THE_AIR: &str = "The vehicle may be in the air with its motors running, and Alight does not steer it any more: an ArduPilot hovers \
                          in GUIDED, a PX4 in HOLD. Take over with the mode switch";

/// Whether this process was interrupted.
pub(crate) struct Interruption {
    signal: watch::Receiver<Option<u8>>,
    /// Ends with this.
    _runtime: Runtime,
}

impl Interruption {
    /// By SIGINT (Ctrl-C), SIGTERM, or SIGHUP (the end of a terminal) unless that is ignored, as `nohup` does. The first signal prints
    /// `what_is_kept`. A second one, except SIGHUP, ends the process at once.
    ///
    /// # Errors
    /// When the handlers of the signals cannot be installed.
    pub(crate) fn on_signals(what_is_kept: &'static str) -> anyhow::Result<Self> {
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(1)
            .enable_all()
            .build()
            .context("starting the runtime that waits for Ctrl-C")?;
        let (sender, receiver) = watch::channel(None);
        let mut signals = {
            let _in_it = runtime.enter();
            Signals::listen().context("waiting for Ctrl-C")?
        };
        runtime.spawn(async move {
            let number = signals.next().await;
            write_error(&format!("interrupted: {what_is_kept}; Ctrl-C again ends it at once"));
            sender.send_replace(Some(number));
            // Both the shell and the kernel send a signal at the end of a terminal, one after the other.
            let number = loop {
                let number = signals.next().await;
                if number != HANGUP {
                    break number;
                }
            };
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
            // The sender is gone, so no request will come.
            std::future::pending::<()>().await;
        }
    }

    /// Success, or the exit status of work that was cut short: that of a process which the signal ended.
    pub(crate) fn exit_code(&self) -> ExitCode {
        self.signal.borrow().map_or(ExitCode::SUCCESS, |number| ExitCode::from(BY_SIGNAL + number))
    }
}

/// The signals that interrupt.
struct Signals {
    interrupts: Signal,
    terminations: Signal,
    hangups: Option<Signal>,
}

impl Signals {
    fn listen() -> std::io::Result<Self> {
        // A handler would undo that SIGHUP is ignored.
        let hangups = match ignores_hangups() {
            true => None,
            false => Some(signal(SignalKind::hangup())?),
        };
        Ok(Self {
            interrupts: signal(SignalKind::interrupt())?,
            terminations: signal(SignalKind::terminate())?,
            hangups,
        })
    }

    /// The number of the next one.
    async fn next(&mut self) -> u8 {
        let hangup = async {
            match &mut self.hangups {
                Some(hangups) => hangups.recv().await,
                None => std::future::pending().await,
            }
        };
        tokio::select! {
            _ = self.interrupts.recv() => INTERRUPT,
            _ = self.terminations.recv() => TERMINATE,
            _ = hangup => HANGUP,
        }
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use rustix::process::{Signal, getpid, kill_process};

    use super::*;

    const TIMEOUT: Duration = Duration::from_secs(20);

    /// Each handler in a process receives all signals, so one test sends them all, in a process without other tests.
    #[test]
    fn a_signal_asks_for_the_end_and_gives_the_exit_status() {
        const ALONE: &str = "ALIGHT_TEST_OF_SIGNALS";
        if std::env::var_os(ALONE).is_none() {
            let name = "interruption::tests::a_signal_asks_for_the_end_and_gives_the_exit_status";
            let mut test = std::process::Command::new(std::env::current_exe().unwrap());
            let output = test.args(["--exact", name]).env(ALONE, "1").output().unwrap();
            let text = String::from_utf8_lossy(&output.stdout);
            assert!(output.status.success() && text.contains("1 passed"), "{text}");
            return;
        }
        let waiting = tokio::runtime::Builder::new_current_thread().enable_time().build().unwrap();
        for (signal, status) in [(Signal::INT, 130), (Signal::TERM, 143), (Signal::HUP, 129)] {
            if signal == Signal::HUP && ignores_hangups() {
                continue;
            }
            let interruption = Interruption::on_signals("nothing is kept").unwrap();
            assert!(!interruption.is_requested());
            kill_process(getpid(), signal).unwrap();
            let requested = async { tokio::time::timeout(TIMEOUT, interruption.requested()).await };
            waiting.block_on(requested).unwrap();
            assert!(interruption.is_requested());
            if signal == Signal::HUP {
                // If a second one ended the process, this test would end here.
                kill_process(getpid(), signal).unwrap();
                std::thread::sleep(Duration::from_millis(200));
            }
            assert_eq!(interruption.exit_code(), ExitCode::from(status), "{signal:?}");
        }
    }
}
