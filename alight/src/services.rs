//! One service in this process.

use std::future::Future;
use std::process::ExitCode;

use anyhow::Context;
use clap::ValueEnum;
use node::{Identity, Layers, Node, Settings, Shutdown};

use crate::cli::ServiceArgs;

/// The services.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum Service {
    /// Frames from image files.
    CameraPub,
    /// Frames to detections.
    Detector,
    /// Detections to velocity setpoints.
    Controller,
    /// Topics to and from the ground station.
    GcsBridge,
    /// The world, the vehicle, its autopilot and its camera.
    Simulator,
}

impl Service {
    /// The service's name: its subcommand, its package, and its part of topic keys.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::CameraPub => "camera-pub",
            Self::Detector => "detector",
            Self::Controller => "controller",
            Self::GcsBridge => "gcs-bridge",
            Self::Simulator => "simulator",
        }
    }

    /// The configuration of the service under some layers, as TOML.
    pub(crate) fn effective_config(self, layers: &Layers) -> anyhow::Result<toml::Table> {
        Ok(match self {
            Self::CameraPub => layers.load::<camera_pub::Config>()?.table,
            Self::Detector => layers.load::<detector::Config>()?.table,
            Self::Controller => layers.load::<controller::Config>()?.table,
            Self::GcsBridge => layers.load::<gcs_bridge::Config>()?.table,
            Self::Simulator => layers.load::<simulator::Config>()?.table,
        })
    }
}

/// Runs a service until it ends or is asked to stop.
pub(crate) fn run(service: Service, args: &ServiceArgs) -> anyhow::Result<ExitCode> {
    if let Some(parent) = args.stop_with_parent
        && !stop_with_parent(parent)
    {
        return Ok(ExitCode::FAILURE);
    }
    node::start_logging("info");
    let layers = Layers { file: args.config.clone(), set: args.set.clone() };
    match service {
        Service::CameraPub => serve(service, args, &layers, instance_of_camera, camera_pub::run),
        Service::Detector => {
            serve(service, args, &layers, |c: &detector::Config| c.id.clone(), detector::run)
        }
        Service::Controller => {
            serve(service, args, &layers, |c: &controller::Config| c.id.clone(), controller::run)
        }
        Service::GcsBridge => {
            serve(service, args, &layers, |c: &gcs_bridge::Config| c.id.clone(), gcs_bridge::run)
        }
        Service::Simulator => {
            serve(service, args, &layers, |c: &simulator::Config| c.id.clone(), simulator::run)
        }
    }
}

fn instance_of_camera(config: &camera_pub::Config) -> String {
    config.instance().to_owned()
}

fn serve<C, F, Fut>(
    service: Service,
    args: &ServiceArgs,
    layers: &Layers,
    instance: impl FnOnce(&C) -> String,
    run: F,
) -> anyhow::Result<ExitCode>
where
    C: Settings,
    F: FnOnce(Node, C, Shutdown) -> Fut,
    Fut: Future<Output = anyhow::Result<()>>,
{
    let config = layers.load::<C>()?.settings;
    let identity = Identity { service: service.name(), instance: instance(&config) };
    let zenoh = args.network.source(service.name())?;
    runtime()?
        .block_on(node::run(identity, &zenoh, |node, shutdown| run(node, config, shutdown)))
        .with_context(|| format!("running {}", service.name()))?;
    Ok(ExitCode::SUCCESS)
}

/// The runtime of a service: two workers, as nothing but messages runs on them.
pub(crate) fn runtime() -> anyhow::Result<tokio::runtime::Runtime> {
    tokio::runtime::Builder::new_multi_thread()
        .worker_threads(2)
        .enable_all()
        .build()
        .context("starting the asynchronous runtime")
}

/// Ends with the parent from now on; false when the parent has ended already.
#[cfg(target_os = "linux")]
pub(crate) fn stop_with_parent(parent: u32) -> bool {
    let signal = Some(rustix::process::Signal::TERM);
    // Without it the process would merely outlive a parent that was killed.
    let _ = rustix::process::set_parent_process_death_signal(signal);
    std::os::unix::process::parent_id() == parent
}

#[cfg(not(target_os = "linux"))]
fn stop_with_parent(_parent: u32) -> bool {
    true
}
