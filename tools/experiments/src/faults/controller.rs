//! Simulates the controller's process in lock-step: it runs, is stopped or killed and started again, and the packets,
//! detections and ticks for it wait or are lost meanwhile.

use std::collections::VecDeque;

use autopilot::Parser;
use controller::pad_note::PadNote;
use controller::tape::TapedFlight;
use messages::{CameraInfo, ControllerStatus, Detections, Phase, Tape};

use crate::landing::configuration;

/// Packets that a socket keeps for a process that does not read them; newer ones are lost.
const MAX_PACKETS: usize = 256;
/// Detections that a mailbox keeps; older ones go.
const MAX_DETECTIONS: usize = 64;
/// News of detectors and cameras that wait; they are few.
const MAX_NEWS: usize = 1024;

/// Messages of others that come once, or seldom.
#[derive(Clone, Debug)]
pub enum News {
    /// A detector came (true) or went.
    Presence(String, bool),
    /// A camera's calibration and mount.
    Camera(CameraInfo),
}

/// Whether the process runs.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub enum Life {
    /// It runs.
    Runs,
    /// It is stopped.
    Stopped,
    /// It is gone.
    Dead,
}

/// The order in which a process that continues finds its work: in the real process it is random.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub struct Order {
    /// Its clock ticks before it reads anything.
    pub tick_first: bool,
    /// Detections are read before packets.
    pub detections_first: bool,
}

/// The controller's process.
pub struct Controller {
    settings: Vec<String>,
    order: Order,
    flight: Option<TapedFlight>,
    /// Its file with the pad's position.
    pad_file: Option<PadNote>,
    life: Life,
    parser: Parser,
    /// The events that the flights have handled, if they are kept.
    tapes: Option<Vec<Tape>>,
    packets: VecDeque<Vec<u8>>,
    detections: VecDeque<(String, Vec<u8>)>,
    news: VecDeque<News>,
}

impl Controller {
    /// A controller that has just started, with these settings.
    ///
    /// # Errors
    /// When a setting is invalid.
    pub fn new(now_ns: i64, settings: &[String], order: Order) -> anyhow::Result<Self> {
        let mut controller = Self {
            settings: settings.to_vec(),
            order,
            flight: None,
            pad_file: None,
            life: Life::Dead,
            parser: Parser::new(),
            tapes: None,
            packets: VecDeque::new(),
            detections: VecDeque::new(),
            news: VecDeque::new(),
        };
        controller.start(now_ns, None)?;
        Ok(controller)
    }

    /// Keeps the handled events from now on.
    pub fn keep_tapes(&mut self) {
        self.tapes.get_or_insert_default();
    }

    /// The events that were handled since [`Controller::keep_tapes`], of each life.
    pub fn into_tapes(mut self) -> Vec<Tape> {
        self.take_tape();
        self.tapes.unwrap_or_default()
    }

    fn take_tape(&mut self) {
        let tape = self.flight.as_mut().and_then(TapedFlight::take_tape);
        if let Some(tapes) = &mut self.tapes {
            tapes.extend(tape);
        }
    }

    fn start(&mut self, now_ns: i64, more: Option<&str>) -> anyhow::Result<()> {
        let settings = self.settings.iter().cloned().chain(more.map(str::to_owned));
        let set: Vec<String> = settings.collect();
        let config = configuration::<controller::Config>("controller", &set)?.settings;
        let mut flight = TapedFlight::new(now_ns, config, std::sync::Arc::default())?;
        if let Some(note) = self.pad_file.clone() {
            flight.take_over_pad(now_ns, note);
        }
        self.flight = Some(flight);
        self.life = Life::Runs;
        Ok(())
    }

    /// True when it runs.
    pub fn runs(&self) -> bool {
        self.life == Life::Runs
    }

    /// Lets it run, stops it or ends it. A controller that is started again resumes the landing and needs the
    /// news again: then this is true.
    ///
    /// # Errors
    /// When its settings are invalid.
    pub fn set_life(&mut self, now_ns: i64, life: Life) -> anyhow::Result<bool> {
        let before = std::mem::replace(&mut self.life, life);
        if life == Life::Dead {
            self.take_tape();
            self.flight = None;
            self.parser = Parser::new();
            self.packets.clear();
            self.detections.clear();
            self.news.clear();
        }
        if life == Life::Runs && before == Life::Dead {
            self.start(now_ns, Some("start=resume"))?;
            return Ok(true);
        }
        if life == Life::Runs && before == Life::Stopped && self.order.tick_first {
            self.tick(now_ns);
        }
        Ok(false)
    }

    /// A packet arrives from the autopilot.
    pub fn packet(&mut self, packet: Vec<u8>) {
        if self.life != Life::Dead && self.packets.len() < MAX_PACKETS {
            self.packets.push_back(packet);
        }
    }

    /// Detections arrive, on the key of this detector.
    pub fn detections(&mut self, publisher: &str, payload: Vec<u8>) {
        if self.life == Life::Dead {
            return;
        }
        if self.detections.len() >= MAX_DETECTIONS {
            self.detections.pop_front();
        }
        self.detections.push_back((publisher.to_owned(), payload));
    }

    /// News arrive.
    pub fn news(&mut self, news: News) {
        if self.life != Life::Dead && self.news.len() < MAX_NEWS {
            self.news.push_back(news);
        }
    }

    /// Reads the messages that have arrived, if it runs.
    pub fn read(&mut self, now_ns: i64) {
        if self.life != Life::Runs {
            return;
        }
        self.read_news(now_ns);
        if self.order.detections_first {
            self.read_detections(now_ns);
            self.read_packets(now_ns);
        } else {
            self.read_packets(now_ns);
            self.read_detections(now_ns);
        }
    }

    fn read_news(&mut self, now_ns: i64) {
        let Some(flight) = &mut self.flight else { return };
        for news in self.news.drain(..) {
            match news {
                News::Presence(detector, alive) => flight.presence(now_ns, &detector, alive),
                News::Camera(info) => flight.camera(now_ns, info),
            }
        }
    }

    fn read_packets(&mut self, now_ns: i64) {
        let Some(flight) = &mut self.flight else { return };
        for datagram in self.packets.drain(..) {
            // A datagram holds complete packets: an incomplete one in it stays so, as in the real link.
            let mut packets = self.parser.push(&datagram);
            packets.extend(self.parser.finish());
            for packet in packets {
                flight.packet(now_ns, &packet);
            }
        }
    }

    fn read_detections(&mut self, now_ns: i64) {
        let Some(flight) = &mut self.flight else { return };
        for (publisher, payload) in self.detections.drain(..) {
            // Payloads that cannot be decoded are counted and skipped by the network's code.
            if let Ok(message) = messages::decode::<Detections>(&payload) {
                flight.detections(now_ns, &publisher, &message);
            }
        }
    }

    /// Lets its clock tick, if it runs.
    pub fn tick(&mut self, now_ns: i64) {
        if self.life == Life::Runs
            && let Some(flight) = &mut self.flight
        {
            flight.tick(now_ns);
            self.pad_file = flight.flight().pad_note().cloned();
            self.take_tape();
        }
    }

    /// Its status, if it runs.
    pub fn status(&self, now_ns: i64) -> Option<ControllerStatus> {
        self.flight.as_ref().filter(|_| self.runs()).map(|flight| flight.flight().status(now_ns))
    }

    /// The next packet to the autopilot.
    pub fn poll_outgoing(&mut self) -> Option<Vec<u8>> {
        self.flight.as_mut().filter(|_| self.life == Life::Runs)?.poll_outgoing()
    }
}

/// True for a phase after which the controller does nothing more on its own.
pub fn is_terminal(phase: Phase) -> bool {
    matches!(phase, Phase::Landed | Phase::Aborted | Phase::PilotInCommand | Phase::Failed)
}
