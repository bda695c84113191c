//! Offers messages, and frames with a picture, to viewers that follow a flight over WebSocket; listens at the configured
//! address, and does nothing while no viewer follows.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use anyhow::Context;
use flightlog::Record;
use flightlog::writer::dropped;
use node::{HealthCounters, Node, Tapped, clock_name, now_ns};
use tokio::net::TcpListener;
use tokio::task::JoinHandle;

use crate::config::Config;
use crate::frame::{Frame, received};
use crate::hub::Hub;
use crate::server::{Server, serve};

/// The reason for which a recorder that serves beyond this machine counts an error in its health.
const INSECURE: &str = "insecure: every computer in the network can follow the flight";

/// The reason for which a recorder counts an error that cannot listen at its address for viewers.
const UNSERVED: &str = "viewers are not served";
/// Period in which such an address is tried again.
const RETRY_PERIOD: Duration = Duration::from_secs(2);

/// Offers messages while a viewer follows; without a viewer it does no work.
pub(crate) struct Live {
    hub: Arc<Hub>,
    health: Arc<HealthCounters>,
    records: flightlog::Live,
    /// How many lost messages were reported to the viewers.
    reported_lost: Option<u64>,
    task: JoinHandle<()>,
}

impl Live {
    /// Listens at the configured address; `None` without one. A recording does not depend on it: where there is a
    /// file, an address at which it cannot listen is tried again.
    ///
    /// # Errors
    /// When the address is taken or of another machine, and there is no file.
    pub(crate) async fn listen(node: &Node, config: &Config) -> anyhow::Result<Option<Self>> {
        if config.serve.is_empty() {
            return Ok(None);
        }
        let address: SocketAddr = config.serve.parse().context("`serve`")?;
        let health = node.shared_health();
        let listener = match bind(address).await {
            Ok(listener) => Some(listener),
            Err(error) if config.has_file() => {
                health.failed(UNSERVED);
                tracing::error!(problem = format!("{error:#}"), "No viewer is served yet");
                None
            }
            Err(error) => return Err(error),
        };
        let hub = Arc::new(Hub::new(config.max_clients as usize));
        let server = Server {
            hub: Arc::clone(&hub),
            health: Arc::clone(&health),
            name: format!("alight recorder {}", config.id),
            session: format!("{}-{}", std::process::id(), now_ns()),
            origins: config.origins.clone(),
        };
        let failures = Arc::clone(&health);
        let task = tokio::spawn(async move {
            // The recording continues.
            if let Err(error) = serve_at(address, listener, server, &failures).await {
                failures.failed(UNSERVED);
                tracing::error!(problem = format!("{error:#}"), "No viewer is served any more");
            }
        });
        let records = flightlog::Live::new(0, clock_name());
        Ok(Some(Self { hub, health, records, reported_lost: None, task }))
    }

    /// Whether a client follows; the first one receives the last values of all states.
    pub(crate) fn is_followed<'a>(
        &mut self,
        utc_offset_ns: impl FnOnce() -> i64,
        states: impl IntoIterator<Item = &'a Tapped>,
    ) -> bool {
        if self.hub.take_begun() {
            self.records = flightlog::Live::new(utc_offset_ns(), clock_name());
            self.reported_lost = None;
            for state in states {
                self.take(state, None);
            }
        }
        self.hub.is_followed()
    }

    /// Offers a message; a frame with its picture.
    pub(crate) fn take(&mut self, message: &Tapped, frame: Option<&Frame>) {
        let records = match frame {
            Some(Frame { header, picture, .. }) => {
                self.records.frame(received(message), header, picture)
            }
            None => self.records.message(received(message)),
        };
        for record in records {
            self.offer(record, message.received_ns, message.is_state);
        }
    }

    /// Reports the lost messages to the viewers, when their number has changed.
    pub(crate) fn report_lost(&mut self, lost: &BTreeMap<String, u64>) {
        let sum = lost.values().sum();
        if self.reported_lost.replace(sum) != Some(sum) {
            self.offer(dropped(now_ns(), lost), now_ns(), true);
        }
    }

    fn offer(&self, record: Record, received_ns: i64, is_state: bool) {
        let missed = self.hub.offer(record, self.records.utc_ns(received_ns), is_state);
        for _ in 0..missed {
            self.health.dropped("a viewer is too slow");
        }
    }
}

async fn bind(address: SocketAddr) -> anyhow::Result<TcpListener> {
    TcpListener::bind(address).await.with_context(|| {
        format!("listening at {address} for viewers; another program has the port, or the address is of another machine: choose another with `serve`: `alight record --serve IP:PORT`, `alight land --record FILE.mcap --set recorder.serve=IP:PORT`")
    })
}

/// Serves viewers; without a listener, as soon as it can listen at the address.
async fn serve_at(
    address: SocketAddr,
    listener: Option<TcpListener>,
    server: Server,
    health: &HealthCounters,
) -> anyhow::Result<()> {
    let listener = match listener {
        Some(listener) => listener,
        None => loop {
            tokio::time::sleep(RETRY_PERIOD).await;
            if let Ok(listener) = bind(address).await {
                break listener;
            }
        },
    };
    let address = listener.local_addr().context("the address for viewers")?;
    tracing::info!("Foxglove and Lichtblick follow the flight at ws://{address}");
    if !address.ip().is_loopback() && health.failed(INSECURE) {
        tracing::warn!(
            "INSECURE: every computer that reaches {address} can follow the flight, pictures included"
        );
    }
    match serve(listener, server).await {}
}

impl Drop for Live {
    fn drop(&mut self) {
        self.task.abort();
    }
}
