//! Lists the services by name, from camera-pub to the simulator, loads the effective configuration of each, and runs one in this process
//! until it is stopped.

use std::future::Future;
use std::process::ExitCode;

use anyhow::Context;
use clap::ValueEnum;
use node::access::key_name;
use node::{Effective, INSECURE, Identity, Layers, Network, Node, Settings, Shutdown};

use crate::args::{ServiceArgs, source_of};
use crate::runtime::block_on;

/// The services.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum Service {
    /// A camera (a device, a program, a stream or image files) to frames.
    CameraPub,
    /// Frames to detections.
    Detector,
    /// Detections to velocity setpoints.
    Controller,
    /// Topics to and from the ground station.
    GcsBridge,
    /// Topics to a file.
    Recorder,
    /// Topics to a browser.
    Dashboard,
    /// A simulated world: vehicle, autopilot, camera.
    Simulator,
}

impl Service {
    /// The name of the service: of its subcommand (the recorder's is also `record`), its package, and its topic keys.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::CameraPub => "camera-pub",
            Self::Detector => "detector",
            Self::Controller => "controller",
            Self::GcsBridge => "gcs-bridge",
            Self::Recorder => "recorder",
            Self::Dashboard => "dashboard",
            Self::Simulator => "simulator",
        }
    }

    /// The effective configuration of the service, as TOML.
    pub(crate) fn effective_config(self, layers: &Layers) -> anyhow::Result<toml::Table> {
        Ok(match self {
            Self::CameraPub => layers.load::<camera_pub::Config>()?.table,
            Self::Detector => layers.load::<detector::Config>()?.table,
            Self::Controller => layers.load::<controller::Config>()?.table,
            Self::GcsBridge => layers.load::<gcs_bridge::Config>()?.table,
            Self::Recorder => layers.load::<recorder::Config>()?.table,
            Self::Dashboard => layers.load::<dashboard::Config>()?.table,
            Self::Simulator => layers.load::<simulator::Config>()?.table,
        })
    }
}

/// Runs a service until it ends or is asked to stop.
pub(crate) fn run(service: Service, args: &ServiceArgs) -> anyhow::Result<ExitCode> {
    if !args.parent.follow() {
        return Ok(ExitCode::FAILURE);
    }
    node::start_logging("info");
    match service {
        Service::CameraPub => {
            serve(service, args, |c: &camera_pub::Config| c.instance().to_owned(), camera_pub::run)
        }
        Service::Detector => {
            serve(service, args, |c: &detector::Config| c.id.clone(), detector::run)
        }
        Service::Controller => {
            serve(service, args, |c: &controller::Config| c.id.clone(), controller::run)
        }
        Service::GcsBridge => {
            serve(service, args, |c: &gcs_bridge::Config| c.id.clone(), gcs_bridge::run)
        }
        Service::Recorder => {
            serve(service, args, |c: &recorder::Config| c.id.clone(), recorder::run)
        }
        Service::Dashboard => {
            serve(service, args, |c: &dashboard::Config| c.id.clone(), dashboard::run)
        }
        Service::Simulator => {
            serve(service, args, |c: &simulator::Config| c.id.clone(), simulator::run)
        }
    }
}

/// Warns in the log and in the health report that anyone in reach can command the vehicle.
pub(crate) fn warn_if_open(node: &Node, network: &Network) {
    if network.is_open().unwrap_or(false) && node.health().failed(INSECURE) {
        tracing::warn!(
            "INSECURE: this process listens beyond this machine without keys, so anyone in reach can command the vehicle; see `alight keys`"
        );
    }
}

fn serve<C, F, Fut>(
    service: Service,
    args: &ServiceArgs,
    instance: impl FnOnce(&C) -> String,
    run: F,
) -> anyhow::Result<ExitCode>
where
    C: Settings,
    F: FnOnce(Node, C, Shutdown) -> Fut,
    Fut: Future<Output = anyhow::Result<()>>,
{
    let layers = Layers { file: args.config.clone(), set: args.set.clone() };
    let Effective { settings: config, table } = layers.load::<C>()?;
    let identity = Identity { service: service.name(), instance: instance(&config) };
    let network = args.network.network();
    let zenoh = source_of(&network, &key_name(service.name(), &identity.instance))?;
    block_on(node::run(identity, &zenoh, async |node, shutdown| {
        warn_if_open(&node, &network);
        let publisher = node.clone();
        tokio::select! {
            result = run(node, config, shutdown) => result,
            result = publisher.publish_configuration(table.to_string()) => result,
        }
    }))?
    .with_context(|| format!("running {}", service.name()))?;
    Ok(ExitCode::SUCCESS)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pad_that_is_not_utf_8_is_reported_as_settings_are() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("pad.toml");
        std::fs::write(&file, b"id = 1\n# H\xf6he\n").unwrap();
        let said = format!("the file {file:?} is not UTF-8 in line 2: save it as UTF-8");
        for (service, set) in [
            (Service::Detector, format!("pads=[{file:?}]")),
            (Service::Simulator, format!("pad.markers={file:?}")),
        ] {
            let layers = Layers { file: None, set: vec![set] };
            let problem = service.effective_config(&layers).unwrap_err().to_string();
            assert!(problem.contains(&said), "{problem}");
        }
        let settings = Layers { file: Some(file), set: Vec::new() };
        let problem = Service::Detector.effective_config(&settings).unwrap_err().to_string();
        assert!(problem.contains(&said), "{problem}");
    }
}
