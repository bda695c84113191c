//! Runs the dashboard's service: subscribes to the topics that the page shows, measures round trips to each
//! service, makes the JSON texts for all browsers, and runs the server and the pictures.

use std::net::SocketAddr;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use anyhow::Context;
use messages::topic;
use node::{BoxFuture, Node, Shutdown, clock_name, now_ns};
use tokio::net::TcpListener;
use tokio::time::{MissedTickBehavior, interval};

use crate::config::Config;
use crate::mjpeg;
use crate::server::{App, Texts, serve};
use crate::state::{Input, State};
use crate::video::{Pictures, Video};

/// Period of the data that change with each frame.
const NOW_PERIOD: Duration = Duration::from_millis(100);
/// Period of the data that change slowly, and of the round trips.
const SLOW_PERIOD: Duration = Duration::from_secs(1);
/// Longest wait for the reply of a service.
const ROUND_TRIP_TIMEOUT: Duration = Duration::from_millis(1000);

const CLOSED: &str = "the network session was closed";

/// Serves the page until shutdown.
///
/// # Errors
/// When another dashboard has this name, the address is taken, or the network session cannot be used.
pub fn run(
    node: Node,
    config: Config,
    shutdown: Shutdown,
) -> BoxFuture<'static, anyhow::Result<()>> {
    Box::pin(run_service(node, config, shutdown))
}

async fn run_service(node: Node, config: Config, shutdown: Shutdown) -> anyhow::Result<()> {
    node.claim_unique_name(&config.id).await?;
    let address: SocketAddr = config.listen.parse().context("`listen`")?;
    let listener = TcpListener::bind(address).await.with_context(|| {
        format!("listening at {address} for browsers; another program has the port, or the address is of another machine: choose another with `listen`: `alight dashboard --set listen=IP:PORT`, `alight land --dashboard IP:PORT`")
    })?;
    let state = Arc::new(Mutex::new(State::new(clock_name())));
    let texts = Texts::default();
    let pictures = Pictures::default();
    let video = Video::new(node.clone(), config.video.clone(), Arc::clone(&state), &pictures);
    let mjpeg = mjpeg::run(node.clone(), pictures.clone(), config.video.jpeg_quality);
    let address = listener.local_addr().context("the address of the page")?;
    let app =
        App::new(node.clone(), &config, address, Arc::clone(&state), texts.clone(), pictures)?;
    node.announce().await?;
    tracing::info!("The page is at {}{address}/", app.scheme());
    if !address.ip().is_loopback() && config.certificate().is_none() {
        tracing::warn!(
            "The page is open to the network, for holders of a token, and is not encrypted"
        );
    }
    tokio::select! {
        result = follow(&node, &state) => result,
        result = publish(&state, &texts) => result,
        result = measure(&node, &state) => result,
        result = video.run() => result,
        result = mjpeg => result,
        result = stream(node.clone(), &config, Arc::clone(&state)) => result,
        never = serve(listener, app) => match never {},
        () = shutdown.requested() => Ok(()),
    }
}

/// Sends pictures as H.264, if the program is built with it.
async fn stream(node: Node, config: &Config, state: Arc<Mutex<State>>) -> anyhow::Result<()> {
    #[cfg(feature = "h264")]
    return crate::stream::Stream::new(node, config.video.clone(), state).run().await;
    #[cfg(not(feature = "h264"))]
    {
        drop((node, config, state));
        std::future::pending().await
    }
}

// The state is complete after each message, also when a thread panics.
fn lock(state: &Mutex<State>) -> MutexGuard<'_, State> {
    state.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Takes the messages of all topics that the page shows.
async fn follow(node: &Node, state: &Mutex<State>) -> anyhow::Result<()> {
    let statuses = node.subscriber(topic::STATUS, &[]).await?;
    let targets = node.subscriber(topic::TARGET, &[]).await?;
    let vehicles = node.subscriber(topic::VEHICLE_STATE, &[]).await?;
    let detections = node.subscriber(topic::DETECTIONS, &[]).await?;
    let detectors = node.subscriber(topic::DETECTOR_INFO, &[]).await?;
    let cameras = node.subscriber(topic::CAMERA_INFO, &[]).await?;
    let healths = node.subscriber(topic::HEALTH, &[]).await?;
    let recorders = node.subscriber(topic::RECORDER_STATUS, &[]).await?;
    let grounds = node.subscriber(topic::GCS_STATUS, &[]).await?;
    let configurations = node.subscriber(topic::CONFIGURATION, &["controller", "*"]).await?;
    loop {
        let input = tokio::select! {
            it = statuses.next() => Input::Status(Box::new(it.context(CLOSED)?)),
            it = targets.next() => Input::Target(Box::new(it.context(CLOSED)?)),
            it = vehicles.next() => Input::Vehicle(Box::new(it.context(CLOSED)?)),
            it = detections.next_with_key() => {
                let (key, found) = it.context(CLOSED)?;
                Input::Detections(name(topic::DETECTIONS.first_name(&key)), Box::new(found))
            }
            it = detectors.next_with_key() => {
                let (key, info) = it.context(CLOSED)?;
                Input::Detector(name(topic::DETECTOR_INFO.first_name(&key)), Box::new(info))
            }
            it = cameras.next_with_key() => {
                let (key, info) = it.context(CLOSED)?;
                Input::Camera(name(topic::CAMERA_INFO.first_name(&key)), Box::new(info))
            }
            it = healths.next_with_key() => {
                let (key, health) = it.context(CLOSED)?;
                let instance = key.rsplit('/').next().unwrap_or_default().to_owned();
                Input::Health(name(topic::HEALTH.first_name(&key)), instance, Box::new(health))
            }
            it = recorders.next_with_key() => {
                let (key, status) = it.context(CLOSED)?;
                Input::Recorder(name(topic::RECORDER_STATUS.first_name(&key)), Box::new(status))
            }
            it = grounds.next() => Input::Ground(Box::new(it.context(CLOSED)?)),
            it = configurations.next() => Input::Configuration(Box::new(it.context(CLOSED)?)),
        };
        lock(state).take(now_ns(), input);
    }
}

fn name(name: Option<&str>) -> String {
    name.unwrap_or_default().to_owned()
}

/// Makes the texts for all browsers.
async fn publish(state: &Mutex<State>, texts: &Texts) -> anyhow::Result<()> {
    let mut now = interval(NOW_PERIOD);
    now.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let mut slow = interval(SLOW_PERIOD);
    slow.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        tokio::select! {
            _ = now.tick() => {
                let state = lock(state);
                texts.now.send_replace(state.now(now_ns()).to_string().into());
                let version = state.log.version();
                texts.log.send_if_modified(|sent| std::mem::replace(sent, version) != version);
            }
            _ = slow.tick() => {
                let mut state = lock(state);
                state.every_second(now_ns());
                texts.slow.send_replace(state.slow(now_ns()).to_string().into());
            }
        }
    }
}

/// Measures how long a query to each service and its reply take.
async fn measure(node: &Node, state: &Mutex<State>) -> anyhow::Result<()> {
    let mut due = interval(SLOW_PERIOD);
    due.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        due.tick().await;
        let present = lock(state).present();
        for (service, instance) in present {
            let took = node.round_trip(&service, &instance, ROUND_TRIP_TIMEOUT).await;
            let took_ms = took.map(|took| took.as_secs_f64() * 1e3);
            lock(state).round_trip(now_ns(), &service, &instance, took_ms);
        }
    }
}
