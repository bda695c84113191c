//! Zenoh sessions with the local configuration on a free port: frames in shared memory, unique names, presence, last values, commands
//! answered, late or refused.

use std::time::Duration;

use anyhow::{Context, anyhow};
use messages::{
    CommandReply, ControllerCommand, FrameHeader, MavlinkBytes, TOPICS, Tape, Wind, decode, encode,
    topic,
};
use node::{FramePublisher, FrameSubscriber, Identity, Node, ZenohSource, clock_name, now_ns};
use testing::ports;
use tokio::time::timeout;

const PATIENCE: Duration = Duration::from_secs(20);

/// The local configuration with another rendezvous port.
fn local(port: u16) -> ZenohSource {
    ZenohSource::Text(node::session::local_config(port))
}

fn free_port() -> anyhow::Result<u16> {
    let ([port], _, _) = ports::free()?;
    Ok(port)
}

async fn open(service: &'static str, instance: &str, port: u16) -> anyhow::Result<Node> {
    Node::open(Identity { service, instance: instance.into() }, &local(port)).await
}

/// A connected camera and detector, with a publisher and a subscriber of frames.
async fn frames() -> anyhow::Result<([Node; 2], FramePublisher, FrameSubscriber)> {
    let port = free_port()?;
    let camera = open("camera-pub", "down", port).await?;
    let detector = open("detector", "main", port).await?;
    let subscriber = detector.frame_subscriber(topic::FRAME, &["down"]).await?;
    let publisher = camera.frame_publisher(topic::FRAME, &["down"], 64 * 48).await?;
    while !publisher.has_subscribers().await {
        tokio::task::yield_now().await;
    }
    Ok(([camera, detector], publisher, subscriber))
}

fn header(sequence: u64) -> FrameHeader {
    FrameHeader {
        sequence,
        stamp_ns: now_ns(),
        clock: clock_name().into(),
        width: 64,
        height: 48,
        ..FrameHeader::sample()
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn frames_arrive_as_they_were_written_and_invalid_ones_are_skipped() -> anyhow::Result<()> {
    let (_nodes, publisher, subscriber) = frames().await?;
    let too_short = publisher.loan(5);
    publisher.publish(&header(1), too_short).await;
    // A frame published while another one is in flight may be dropped; then another one is published.
    let received = timeout(PATIENCE, async {
        loop {
            let mut frame = publisher.loan(64 * 48);
            for (i, pixel) in frame.iter_mut().enumerate() {
                *pixel = (i % 251) as u8;
            }
            publisher.publish(&header(2), frame).await;
            if let Ok(received) = timeout(Duration::from_millis(500), subscriber.next()).await {
                return received;
            }
        }
    });
    let received = received.await?.context("a frame")?;
    assert_eq!(received.header.sequence, 2);
    assert!(received.bytes().iter().enumerate().all(|(i, p)| *p == (i % 251) as u8));
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn a_pool_that_is_full_falls_back_to_copies() -> anyhow::Result<()> {
    let camera = open("camera-pub", "down", free_port()?).await?;
    let publisher = camera.frame_publisher(topic::FRAME, &["down"], 64 * 48).await?;
    let loans: Vec<_> = (0..8).map(|_| publisher.loan(64 * 48)).collect();
    let shared = loans.iter().filter(|l| matches!(l, node::Loan::Shared(_))).count();
    assert!((3..8).contains(&shared), "{shared} of 8 loans were in shared memory");
    assert!(loans.iter().all(|l| l.len() == 64 * 48));
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn a_pool_exhausted_by_dead_readers_is_replaced() -> anyhow::Result<()> {
    let (_nodes, publisher, subscriber) = frames().await?;
    let is_shared = |loan: &node::Loan| matches!(loan, node::Loan::Shared(_));
    // As by a process that is killed while it reads.
    let shared = std::iter::repeat_with(|| publisher.loan(64 * 48)).take(8).filter(is_shared);
    let kept = shared.map(std::mem::forget).count();
    assert!((1..8).contains(&kept), "{kept} of 8 loans were in shared memory");
    let is_replaced = async || is_shared(&publisher.loan(64 * 48));
    testing::until("the pool is replaced", PATIENCE, is_replaced).await?;
    publisher.publish(&header(99), publisher.loan(64 * 48)).await;
    let received = timeout(PATIENCE, subscriber.next()).await?.context("a frame")?;
    assert_eq!(received.header.sequence, 99);
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn the_others_still_meet_after_the_first_process_is_gone() -> anyhow::Result<()> {
    let port = free_port()?;
    let first = open("simulator", "main", port).await?;
    let second = open("detector", "main", port).await?;
    let presence = second.presence("controller").await?;
    second.announce().await?;
    first.close().await;
    // The third has only the address of the rendezvous, and must find the second.
    let third = open("controller", "main", port).await?;
    third.announce().await?;
    let arrived = timeout(PATIENCE, presence.next()).await?;
    assert_eq!(arrived, Some(("main".to_owned(), true)));
    third.close().await;
    let left = timeout(PATIENCE, presence.next()).await?;
    assert_eq!(left, Some(("main".to_owned(), false)));
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn a_second_instance_of_the_same_name_is_rejected() -> anyhow::Result<()> {
    let port = free_port()?;
    let first = open("detector", "main", port).await?;
    first.claim_unique_name("main").await?;
    first.announce().await?;
    let second = open("detector", "main", port).await?;
    let refusal =
        second.claim_unique_name("main").await.err().context("two of one name")?.to_string();
    let named = format!("`main` already (vehicle `drone`, port {port} of this machine)");
    assert!(refusal.contains(&named) && refusal.contains("--set id="), "{refusal}");
    let spare = open("detector", "spare", port).await?;
    spare.claim_unique_name("spare").await
}

/// Repeats a query until its result satisfies the condition.
async fn until<T>(
    ask: impl AsyncFn() -> anyhow::Result<T>,
    is_wanted: impl Fn(&T) -> bool,
) -> anyhow::Result<T> {
    let asked = async {
        loop {
            let answer = ask().await?;
            if is_wanted(&answer) {
                return anyhow::Ok(answer);
            }
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    };
    timeout(PATIENCE, asked).await?
}

#[tokio::test(flavor = "multi_thread")]
async fn of_two_that_start_at_once_one_has_priority() -> anyhow::Result<()> {
    for [first, second] in [["main", "main"], ["a", "b"], ["b", "a"], ["main", "main"]] {
        let port = free_port()?;
        let host = open("simulator", "main", port).await?;
        // Each in a task of its own, as in its own process: a call of Zenoh that blocks the thread of one `block_on` takes the wake-up of
        // another future there.
        let start = |instance: &'static str| {
            tokio::spawn(async move {
                let node = open("controller", instance, port).await?;
                let alone = node.claim_unique_name("*").await;
                if alone.is_ok() {
                    node.announce().await?;
                }
                anyhow::Ok((node, alone))
            })
        };
        let (first_started, second_started) = (start(first), start(second));
        let both = (first_started.await??, second_started.await??);
        let refusals: Vec<String> = [&both.0, &both.1]
            .iter()
            .filter_map(|it| it.1.as_ref().err())
            .map(ToString::to_string)
            .collect();
        assert_eq!(refusals.len(), 1, "{first} and {second}: {refusals:?}");
        let left = until(async || host.alive("controller", "*").await, |left| !left.is_empty());
        let left = left.await.context("the one that continues")?;
        assert_eq!(left.len(), 1, "{left:?}");
        both.0.0.close().await;
        both.1.0.close().await;
        host.close().await;
    }
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn a_late_subscriber_gets_the_last_value() -> anyhow::Result<()> {
    let port = free_port()?;
    let controller = open("controller", "main", port).await?;
    let health = controller.publisher(topic::HEALTH, &["controller", "main"]).await?;
    let report = controller.health().report(controller.identity(), now_ns());
    health.publish(&report).await;
    let other = controller.publisher(topic::HEALTH, &["controller", "other"]).await?;
    let other_report = messages::Health { instance: "other".into(), ..report.clone() };
    other.publish(&other_report).await;
    let late = open("alight", "main", port).await?;
    let subscriber = late.subscriber(topic::HEALTH, &[]).await?;
    let mut received = Vec::new();
    while received.len() < 2 {
        received.push(timeout(PATIENCE, subscriber.next()).await?.context("a state")?);
    }
    received.sort_by(|a, b| a.instance.cmp(&b.instance));
    assert_eq!(received, [report, other_report]);
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn foreign_payloads_are_counted_and_skipped() -> anyhow::Result<()> {
    let port = free_port()?;
    let listener = open("alight", "main", port).await?;
    let winds = listener.subscriber(topic::WIND, &[]).await?;
    let foreign = Foreign::open(port).await?;
    let wind = Wind { stamp_ns: 7, velocity_ned_m_s: [1.0, 2.0, 3.0] };
    let other_type = encode(&MavlinkBytes { packet: vec![1] });
    let mut older = encode(&wind);
    older[2] = 0;
    let cut = &encode(&wind)[..9];
    for payload in [&b"not ours"[..], &other_type, &older, cut] {
        let mut arrived = None;
        for _ in 0..50 {
            foreign.put("drone/wind", payload).await?;
            foreign.put("drone/wind", &encode(&wind)).await?;
            arrived = timeout(Duration::from_millis(200), winds.next()).await.ok().flatten();
            if arrived.is_some() {
                break;
            }
        }
        assert_eq!(arrived, Some(wind));
    }
    let refused = listener.health().report(listener.identity(), now_ns()).errors;
    for reason in ["foreign", "wrong type", "wrong version", "damaged"] {
        let reason = format!("payload: {reason}");
        assert!(refused.iter().any(|c| c.reason == reason), "{reason} is not in {refused:?}");
    }
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn a_message_after_the_session_was_closed_is_no_failure() -> anyhow::Result<()> {
    let node = open("alight", "main", free_port()?).await?;
    let winds = node.publisher(topic::WIND, &[]).await?;
    let frames = node.frame_publisher(topic::FRAME, &["down"], 64 * 48).await?;
    let health = node.shared_health();
    let identity = node.identity().clone();
    node.close().await;
    winds.publish(&Wind { stamp_ns: 7, velocity_ned_m_s: [1.0, 2.0, 3.0] }).await;
    let pixels = frames.loan(64 * 48);
    frames.publish(&header(1), pixels).await;
    let errors = health.report(&identity, now_ns()).errors;
    assert!(errors.is_empty(), "{errors:?}");
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn a_command_is_answered_and_a_missing_controller_is_reported() -> anyhow::Result<()> {
    let port = free_port()?;
    let operator = open("alight", "main", port).await?;
    let unanswered = operator
        .command(topic::COMMAND, &[], &ControllerCommand::Hold)
        .await
        .err()
        .context("it is answered")?;
    assert!(unanswered.to_string().contains("no controller answered"), "{unanswered}");
    let controller = open("controller", "main", port).await?;
    let commands = controller.commands(topic::COMMAND, &[]).await?;
    let answering = tokio::spawn(async move {
        while let Some(request) = commands.next().await {
            let own = format!(", alight main on {}", node::host_name());
            assert!(request.sender.ends_with(&own), "{}", request.sender);
            let reason = format!("{:?}", request.message);
            request.answer(&CommandReply { accepted: true, reason }).await;
        }
    });
    // Until the two sessions are connected, the reply is that there is no controller.
    let answered = async {
        loop {
            if let Ok(reply) =
                operator.command(topic::COMMAND, &[], &ControllerCommand::Abort).await
            {
                return reply;
            }
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
    };
    let reply = timeout(PATIENCE, answered).await?;
    assert_eq!(reply, CommandReply { accepted: true, reason: "Abort".into() });
    answering.abort();
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn a_command_that_waited_until_its_sender_gave_up_is_refused() -> anyhow::Result<()> {
    let port = free_port()?;
    let controller = open("controller", "main", port).await?;
    let commands = controller.commands(topic::COMMAND, &[]).await?;
    let foreign = Foreign::open(port).await?;
    let answering = tokio::spawn(async move {
        while let Some(request) = commands.next().await {
            let reason = format!("{} {}", request.sent_ns.is_some(), request.sender);
            request.answer(&CommandReply { accepted: true, reason }).await;
        }
    });
    let start = encode(&ControllerCommand::Start);
    let reply = foreign.ask("drone/controller/command", &[], b"time?").await?;
    let time_ns = i64::from_le_bytes(reply.1.context("no time")?.as_slice().try_into()?);
    assert!((now_ns() - time_ns).abs() < 5_000_000_000, "the recipient's own clock");
    for (sent_ns, accepted) in [
        (time_ns, true),
        (now_ns() - 2_500_000_000, false),
        (now_ns() - 3_600_000_000_000, false),
        // From before the recipient's host was started again.
        (now_ns() + 3_600_000_000_000, false),
    ] {
        let reply =
            foreign.ask("drone/controller/command", &start, &sent_ns.to_le_bytes()).await?.0;
        let reply: CommandReply = decode(&reply)?;
        assert_eq!(reply.accepted, accepted, "{reply:?}");
        assert!(accepted || reply.reason.contains("give it again"), "{reply:?}");
    }
    let time = now_ns().to_le_bytes();
    let named = foreign.ask("drone/controller/command?from=anna\x1b[2J\n", &start, &time).await?.0;
    assert_eq!(decode::<CommandReply>(&named)?.reason, "true anna[2J");
    let odd = [&now_ns().to_le_bytes()[..], b"anna"].concat();
    let odd = foreign.ask("drone/controller/command", &start, &odd).await?.0;
    let odd: CommandReply = decode(&odd)?;
    assert!(!odd.accepted && odd.reason.contains("is no time (8 bytes)"), "{odd:?}");
    let undated: CommandReply =
        decode(&foreign.ask("drone/controller/command", &start, &[]).await?.0)?;
    let reason = "false a sender without a name".to_owned();
    assert_eq!(undated, CommandReply { accepted: true, reason });
    let errors = controller.health().report(controller.identity(), now_ns()).errors;
    let late = errors.iter().find(|count| count.reason == "commands: too late");
    assert_eq!(late.map(|count| count.count), Some(3), "{errors:?}");
    answering.abort();
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn a_recipient_that_does_not_answer_is_sent_no_command() -> anyhow::Result<()> {
    let port = free_port()?;
    let controller = open("controller", "main", port).await?;
    let commands = controller.commands(topic::COMMAND, &[]).await?;
    let operator = open("alight", "main", port).await?;
    // It is stopped until the sender has given up.
    let given_up = operator.command(topic::COMMAND, &[], &ControllerCommand::Start).await;
    assert!(given_up.is_err(), "{given_up:?}");
    let late = timeout(Duration::from_secs(1), commands.next()).await;
    assert!(late.is_err(), "carried out late");
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn a_command_that_was_taken_and_not_answered_may_have_been_carried_out() -> anyhow::Result<()>
{
    // One session for both, which needs not wait until it is connected.
    let node = open("controller", "main", free_port()?).await?;
    let commands = node.commands(topic::COMMAND, &[]).await?;
    let unanswered = async || {
        let reply = node.command(topic::COMMAND, &[], &ControllerCommand::Start).await;
        reply.err().context("it is answered").map(|problem| problem.to_string())
    };
    // It takes the command and ends.
    let (problem, taken) = tokio::join!(unanswered(), async { commands.next().await.map(drop) });
    let (problem, ()) = (problem?, taken.context("no command came")?);
    let part = "sent to the controller, and the connection to it ended before an answer came: it may have been carried out";
    assert!(problem.contains(part), "{problem}");
    // It takes the command and does not continue.
    let (problem, taken) = tokio::join!(unanswered(), commands.next());
    let (problem, _taken) = (problem?, taken.context("no command came")?);
    let part = "no answer came within 2 s: it may have been carried out";
    assert!(problem.contains(part), "{problem}");
    Ok(())
}

/// A Zenoh program without this crate.
struct Foreign {
    session: zenoh::Session,
}

impl Foreign {
    async fn open(port: u16) -> anyhow::Result<Self> {
        let text = format!(
            "{{ mode: 'client', connect: {{ endpoints: ['tcp/127.0.0.1:{port}'] }}, scouting: {{ multicast: {{ enabled: false }} }} }}"
        );
        let config = zenoh::Config::from_json5(&text).map_err(|cause| anyhow!("{cause}"))?;
        let session = zenoh::open(config).await.map_err(|cause| anyhow!("{cause}"))?;
        Ok(Self { session })
    }

    /// Payload and attachment of the first reply to a query; asks until there is one.
    async fn ask(
        &self,
        key: &str,
        payload: &[u8],
        attachment: &[u8],
    ) -> anyhow::Result<(Vec<u8>, Option<Vec<u8>>)> {
        timeout(PATIENCE, async {
            loop {
                let query = self.session.get(key).payload(payload).attachment(attachment);
                let replies = query.await.map_err(|cause| anyhow!("{cause}"))?;
                if let Ok(reply) = replies.recv_async().await
                    && let Ok(sample) = reply.result()
                {
                    let attachment = sample.attachment().map(|it| it.to_bytes().into_owned());
                    return Ok((sample.payload().to_bytes().into_owned(), attachment));
                }
                tokio::time::sleep(Duration::from_millis(20)).await;
            }
        })
        .await?
    }

    async fn put(&self, key: &str, bytes: &[u8]) -> anyhow::Result<()> {
        self.session.put(key, bytes).await.map_err(|cause| anyhow!("{cause}"))
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_tap_gets_each_earlier_message_of_a_record_once_its_publisher_is_there()
-> anyhow::Result<()> {
    let port = free_port()?;
    let recorder = open("recorder", "late", port).await?;
    let rows: Vec<_> = TOPICS.iter().copied().filter(|row| row.key == "controller/tape").collect();
    let tap = recorder.tap(&rows, 1_000_000).await?;
    let controller = open("controller", "main", port).await?;
    let requests = controller.earlier_requests(topic::TAPE).await?;
    let request = timeout(PATIENCE, requests.next()).await?.context("a request")?;
    for first in 0..600 {
        request.send(&Tape { first, ..Tape::default() }).await?;
        // As the controller pauses: sent all at once, some are dropped.
        tokio::time::sleep(Duration::from_millis(1)).await;
    }
    let mut firsts = Vec::new();
    while firsts.len() < 600 {
        let message = tokio::task::block_in_place(|| tap.next(PATIENCE)).context("a message")?;
        assert_eq!(message.key, "controller/tape");
        firsts.push(decode::<Tape>(&message.payload)?.first);
    }
    assert_eq!(firsts, Vec::from_iter(0..600));
    // A second request would double the messages.
    drop(request);
    assert!(timeout(Duration::from_millis(300), requests.next()).await.is_err());
    Ok(())
}
