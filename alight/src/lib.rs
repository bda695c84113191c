//! Lands a UAV on a printed marker: every service and tool as a subcommand of one program.
//!
//! Modules in reading order: [`cli`] is what can be asked, [`services`] runs one service in this process, [`relay`]
//! stands between the drone and the ground; [`up`] runs what a [`site`] says belongs on this machine and listens to its
//! [`neighbours`], [`keys`] makes the keys for it, [`doctor`] says what is wrong; [`land`] runs all services as processes and watches the landing, with
//! [`children`] for the processes, [`progress`] for what is shown meanwhile and [`outcome`] for the result;
//! [`detectors`] lists the detectors that run and [`swap`] replaces one; [`detect`], [`marker`] and [`experiment`] are
//! tools.

mod children;
mod cli;
mod detect;
mod detectors;
mod doctor;
mod experiment;
mod keys;
mod land;
mod marker;
mod neighbours;
mod outcome;
mod progress;
mod relay;
mod services;
mod site;
mod swap;
mod up;

use std::process::ExitCode;

/// Runs the command line of this process.
pub fn main() -> ExitCode {
    node::relaunch_with_zenoh_threads();
    cli::run()
}
