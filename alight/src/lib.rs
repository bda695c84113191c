//! Lands a UAV on a printed marker: every service and tool as a subcommand of one program.
//!
//! Modules in reading order: `cli` is the command line, with the shared `args`; `services` runs one
//! service in this process, `record` a recorder or the repair of its file, `replay` a recording back into decisions, `report` one on a
//! page, `dashboard` a page or a token for it, `relay` connects drone and ground; `up` runs the processes of a `site` on
//! this machine, follows its `peers`, keeps `notes` for the case of a crash and finds the `programs` they need, `keys` makes the site's
//! keys, `doctor` diagnoses it, `cameras` lists the cameras; `land` runs all services as processes and watches the landing, with `children`
//! for the processes, `progress` for the display and `outcome` for the result; `command` sends a command, `detectors` lists the running
//! detectors and `swap` replaces one, with `staleness` for the reason why one is stale; `detect`, `calibrate`, `rectify`, `marker` and `experiment` with its campaign of `faults`, flown in
//! `real_time` over a `fault_link` as well, are tools. `runtime`, `terminal`, `interruption` and `ending` serve all of them.

mod args;
mod calibrate;
mod cameras;
mod children;
mod cli;
mod command;
mod dashboard;
mod detect;
mod detectors;
mod doctor;
mod ending;
mod experiment;
mod fault_link;
mod faults;
mod grey;
mod interruption;
mod keys;
mod land;
mod marker;
mod notes;
mod outcome;
mod peers;
mod programs;
mod progress;
mod real_time;
mod record;
mod rectify;
mod relay;
mod replay;
mod report;
mod runtime;
mod services;
mod site;
mod staleness;
mod swap;
mod terminal;
mod up;

use std::process::ExitCode;

/// Runs the command line of this process.
pub fn main() -> ExitCode {
    node::set_version(cli::VERSION);
    node::relaunch_with_zenoh_threads();
    let status = cli::run();
    node::halt_zenoh();
    status
}
