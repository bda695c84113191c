//! The choice of detector among several with given latencies as they come, crash, fall silent, are preferred or
//! see the marker at two places, with the gaps between used frames.

#![allow(clippy::unwrap_used, reason = "helpers of tests may fail like tests")]

use controller::agreement::{HEADING_TOLERANCE_RAD, Sight, Tolerance};
use controller::selection::{
    Limits, MAX_DETECTORS, MAX_SILENCE_NS, MAX_VERDICTS, MIN_SILENCE_NS, Preference, Selection,
};
use messages::{DetectorState, Place};
use proptest::prelude::*;

const MS: i64 = 1_000_000;
const PERIOD: i64 = 67 * MS;

fn limits() -> Limits {
    Limits {
        max_age_s: 0.2,
        max_latency_s: 0.6,
        min_rate_hz: 3.0,
        return_after_s: 2.0,
        tolerance: Tolerance { base_m: 0.1, per_m: 0.03, heading_rad: Some(HEADING_TOLERANCE_RAD) },
        needs_pose: true,
        no_pose_after_s: 0.0,
    }
}

fn preferring(detector: Option<&str>, place: Option<Place>) -> Selection {
    Selection::new(limits(), Preference { detector: detector.map(Into::into), place })
}

/// The marker at a place, its upper edge forward.
fn place(position_m: [f64; 3]) -> Sight {
    turned(position_m, 0.0)
}

/// The marker at a place, its upper edge turned clockwise by this.
fn turned(position_m: [f64; 3], heading_deg: f64) -> Sight {
    Sight {
        position_m: Some(position_m),
        heading_rad: Some(f64::to_radians(heading_deg)),
        has_pose: true,
    }
}

/// Detectors that answer to the frames of one camera, each with its latency, and the frames that were used.
struct Bench {
    selection: Selection,
    now_ns: i64,
    /// Stamps used, with the time of their use and their detector.
    used: Vec<(i64, i64, String)>,
    /// When which detector became the active one.
    changes: Vec<(i64, String)>,
}

impl Bench {
    fn new(selection: Selection) -> Self {
        Self { selection, now_ns: 0, used: Vec::new(), changes: Vec::new() }
    }

    /// Notes the result of the last call, and checks the invariants.
    fn note(&mut self) {
        if let Some((name, stamp)) = self.selection.next_frame() {
            assert_eq!(self.selection.active(), Some(name.as_str()));
            assert!(self.used.last().is_none_or(|last| last.0 < stamp), "an older stamp");
            self.used.push((stamp, self.now_ns, name));
        }
        let active = self.selection.active().unwrap_or("none").to_owned();
        let last = self.changes.last().map_or("none", |(_, last)| last.as_str());
        if last != active {
            self.changes.push((self.now_ns, active));
        }
    }

    /// Lets time pass up to a frame's stamp plus 66 ms: ticks every 25 ms, and the answers of those that
    /// answer.
    fn frame(&mut self, stamp_ns: i64, answers: &[(&str, i64)]) {
        let sight = Some(place([0.0, 0.0, 5.0]));
        let answers: Vec<_> = answers.iter().map(|(name, late)| (*name, *late, sight)).collect();
        self.frame_seen(stamp_ns, &answers);
    }

    fn frame_seen(&mut self, stamp_ns: i64, answers: &[(&str, i64, Option<Sight>)]) {
        let answered = |(name, late, sight): &(_, i64, _)| (stamp_ns + late, Some((*name, *sight)));
        let mut events: Vec<_> = answers.iter().map(answered).collect();
        events.extend((0..3).map(|i| (stamp_ns + i * 25 * MS, None)));
        events.sort_by_key(|(at, _)| *at);
        for (at, event) in events {
            self.now_ns = self.now_ns.max(at);
            match event {
                Some((name, sight)) => {
                    self.selection.received(self.now_ns, name, stamp_ns, sight);
                }
                None => self.selection.tick(self.now_ns),
            }
            self.note();
        }
    }

    fn frames(&mut self, frames: std::ops::Range<i64>, answers: &[(&str, i64)]) {
        frames.for_each(|i| self.frame(i * PERIOD, answers));
    }

    fn gone(&mut self, name: &str) {
        self.selection.presence(self.now_ns, name, false);
        self.note();
    }

    fn state(&self, name: &str) -> DetectorState {
        let all = self.selection.candidates(self.now_ns);
        all.iter().find(|candidate| candidate.detector == name).unwrap().state
    }

    fn longest_gap_ms(&self) -> i64 {
        self.used.windows(2).map(|pair| (pair[1].1 - pair[0].1) / MS).max().unwrap_or(0)
    }
}

const BOTH: [(&str, i64); 2] = [("main", 30 * MS), ("spare", 35 * MS)];

#[test]
fn one_detector_is_used_and_the_other_stands_by() {
    let mut bench = Bench::new(preferring(None, None));
    bench.frames(0..30, &BOTH);
    assert_eq!(bench.changes.len(), 1);
    assert_eq!(
        (bench.state("main"), bench.state("spare")),
        (DetectorState::Active, DetectorState::Shadow)
    );
    assert_eq!(bench.used.len(), 30);
    let spare = &bench.selection.candidates(bench.now_ns)[1];
    assert_eq!((spare.compared, spare.agreed), (30, 30));
    assert!((spare.rate_hz - 15.0).abs() < 0.5 && (spare.latency_ms - 35.0).abs() < 0.1);
}

#[test]
fn a_crash_hands_over_at_once_and_uses_the_frame_that_is_there() {
    let mut bench = Bench::new(preferring(None, None));
    bench.frames(0..10, &BOTH);
    // The active one dies over a frame that the other has searched.
    bench.frame(10 * PERIOD, &BOTH[1..]);
    bench.gone("main");
    assert_eq!(bench.selection.active(), Some("spare"));
    assert_eq!(bench.used.last().unwrap().0, 10 * PERIOD);
    bench.frames(11..20, &BOTH[1..]);
    assert_eq!(bench.used.len(), 20);
    assert!(
        bench.selection.why().contains("main: it has left the network"),
        "{}",
        bench.selection.why()
    );
    assert_eq!(bench.selection.changes(), 1);
}

#[test]
fn a_silent_one_is_replaced_within_three_of_its_periods_whatever_the_latencies() {
    for latency_ms in [5, 30, 60, 100, 140] {
        for spare_ms in [5, 30, 60, 100] {
            for period_ms in [20, 33, 67, 100] {
                let answers = [("main", latency_ms * MS), ("spare", spare_ms * MS)];
                let period = period_ms * MS;
                let mut events = Vec::new();
                for (name, late) in answers {
                    let last = if name == "main" { 20 } else { 40 };
                    events.extend((0..last).map(|i| (i * period + late, Some((name, i * period)))));
                }
                events.extend((0..200).map(|i| (i * 25 * MS, None)));
                events.sort_by_key(|(at, _)| *at);
                let mut bench = Bench::new(preferring(None, None));
                bench.selection.received(0, "main", -period, None);
                for (at, event) in events {
                    bench.now_ns = at;
                    match event {
                        Some((name, stamp)) => {
                            bench.selection.received(at, name, stamp, None);
                        }
                        None => bench.selection.tick(at),
                    }
                    bench.note();
                }
                let last_ns = 19 * period + latency_ms * MS;
                let taken_over =
                    bench.changes.iter().find(|(at, name)| *at > last_ns && name == "spare");
                let took_ns = taken_over.unwrap().0 - last_ns;
                // The other must have had a newer frame for a period; a tick may pass before it is noticed.
                let lag_ns = (spare_ms - latency_ms).max(0) * MS;
                let bound_ns = (3 * period).max(2 * period + lag_ns).max(MIN_SILENCE_NS) + 25 * MS;
                assert!(
                    took_ns <= bound_ns,
                    "{latency_ms} {spare_ms} {period_ms}: {} ms",
                    took_ns / MS
                );
            }
        }
    }
}

#[test]
fn a_lost_frame_and_a_camera_that_pauses_change_nothing() {
    let mut bench = Bench::new(preferring(None, None));
    bench.frames(0..10, &BOTH);
    bench.frame(10 * PERIOD, &BOTH[1..]);
    bench.frames(11..20, &BOTH);
    for i in 20..60 {
        bench.frame(i * PERIOD, &[]);
    }
    // The spare one is faster after the pause.
    bench.frames(60..80, &[("main", 35 * MS), ("spare", 20 * MS)]);
    assert_eq!(bench.changes.len(), 1, "{:?}", bench.changes);
}

#[test]
fn the_operators_choice_is_followed_at_once_and_left_while_it_is_not_healthy() {
    let mut bench = Bench::new(preferring(None, None));
    assert!(bench.selection.prefer(0, "spare").unwrap_err().contains("known detectors: none"));
    bench.frames(0..10, &BOTH);
    assert!(bench.selection.prefer(bench.now_ns, "spare").unwrap().contains("is used while"));
    bench.note();
    assert_eq!(bench.selection.active(), Some("spare"));
    bench.frames(10..20, &BOTH);
    bench.frames(20..30, &BOTH[..1]);
    assert_eq!(bench.selection.active(), Some("main"));
    let why = bench.selection.why().to_owned();
    assert!(why.contains("at the change from spare: it has been silent for"), "{why}");
    // Back only after it was healthy for a while.
    bench.frames(30..58, &BOTH);
    assert_eq!(bench.selection.active(), Some("main"));
    bench.frames(58..64, &BOTH);
    assert_eq!(
        (bench.selection.active(), bench.selection.why()),
        (Some("spare"), "it is preferred")
    );
    assert_eq!(bench.used.len(), 63);
    bench.gone("main");
    let refused = bench.selection.prefer(bench.now_ns, "main").unwrap_err();
    assert!(refused.contains("has gone"), "{refused}");
}

#[test]
fn a_place_is_preferred_and_left_and_taken_again() {
    let mut bench = Bench::new(preferring(None, None));
    let answers = [("air", 30 * MS), ("ground", 95 * MS)];
    let none_yet = bench.selection.prefer_place(0, Place::Ground);
    assert!(none_yet.contains("none yet"), "{none_yet}");
    bench.selection.set_place(0, "air", Place::Onboard);
    bench.selection.set_place(0, "ground", Place::Ground);
    bench.frames(0..20, &answers);
    assert_eq!(bench.selection.active(), Some("ground"));
    // The link is cut for three seconds: the process is missed only after its lease.
    bench.frames(20..30, &answers[..1]);
    assert_eq!(bench.selection.active(), Some("air"));
    bench.gone("ground");
    bench.frames(30..65, &answers[..1]);
    bench.selection.presence(bench.now_ns, "ground", true);
    bench.frames(65..90, &answers);
    assert_eq!(bench.selection.active(), Some("air"), "it must prove itself first");
    bench.frames(90..110, &answers);
    assert_eq!(bench.selection.active(), Some("ground"));
    assert!(bench.longest_gap_ms() <= 201, "{}", bench.longest_gap_ms());
    assert_eq!(bench.selection.preference(), "ground");
    // Without the preference the one in use stays, until it fails, and is not taken again.
    let any = bench.selection.prefer_any(bench.now_ns);
    assert!(any.contains("no detector is preferred; `ground` is used"), "{any}");
    assert_eq!(bench.selection.preference(), "");
    bench.frames(110..120, &answers);
    assert_eq!(bench.selection.active(), Some("ground"));
    bench.frames(120..130, &answers[..1]);
    bench.frames(130..190, &answers);
    assert_eq!(bench.selection.active(), Some("air"));
}

#[test]
fn one_that_fails_again_and_again_is_trusted_more_slowly() {
    let mut bench = Bench::new(preferring(Some("main"), None));
    // Silent for half a second, then well for three seconds.
    for i in 0..900 {
        let answers = if i % 52 < 8 { &BOTH[1..] } else { &BOTH[..] };
        bench.frame(i * PERIOD, answers);
    }
    // A minute of it: without doubt it would be 34 changes.
    assert!((3..=6).contains(&bench.selection.changes()), "{}", bench.selection.changes());
}

#[test]
fn slow_and_late_ones_give_way_and_are_better_than_none() {
    let mut bench = Bench::new(preferring(None, None));
    bench.frames(0..20, &[("main", 250 * MS)]);
    assert_eq!(bench.selection.active(), Some("main"), "a late one is better than none");
    bench.frames(20..25, &[("main", 250 * MS), ("spare", 30 * MS)]);
    assert_eq!(bench.selection.active(), Some("spare"));
    assert!(bench.selection.why().contains("at the change from main: its frames are 250 ms old"));
    let mut bench = Bench::new(preferring(None, None));
    for i in 0..100 {
        let slow = i % 7 == 0;
        bench.frame(i * PERIOD, if slow { &BOTH[..1] } else { &[] });
    }
    assert_eq!(bench.selection.active(), Some("main"));
    bench.frames(100..110, &BOTH[1..]);
    assert_eq!(bench.selection.active(), Some("spare"));
}

#[test]
fn one_that_sees_the_marker_elsewhere_is_not_taken_unless_it_is_named() {
    let mut bench = Bench::new(preferring(None, Some(Place::Ground)));
    bench.selection.set_place(0, "spare", Place::Ground);
    let at = |x: f64| Some(place([x, 0.0, 5.0]));
    bench.frames(0..2, &BOTH[..1]);
    for i in 2..100 {
        bench.frame_seen(i * PERIOD, &[("main", 30 * MS, at(0.0)), ("spare", 35 * MS, at(0.8))]);
    }
    assert_eq!(bench.selection.active(), Some("main"));
    let spare = bench.selection.candidates(bench.now_ns).swap_remove(0);
    assert_eq!((spare.compared, spare.agreed), (MAX_VERDICTS as u32, 0));
    assert!((spare.disagreement_m.unwrap() - 0.8).abs() < 1e-9);
    let answer = bench.selection.prefer(bench.now_ns, "spare").unwrap();
    assert!(answer.contains("although it agrees with the active one in only 0 of 30"), "{answer}");
    assert_eq!(bench.selection.active(), Some("spare"));
}

#[test]
fn where_the_active_one_sees_nothing_agreement_is_not_concluded() {
    let mut bench = Bench::new(preferring(None, None));
    let seen = Some(Sight { position_m: None, heading_rad: None, has_pose: true });
    for i in 0..20 {
        // Rarely enough that the active one is not passed over for it.
        let spare = seen.filter(|_| i % 4 == 0);
        let main = seen.filter(|_| false);
        bench.frame_seen(i * PERIOD, &[("main", 30 * MS, main), ("spare", 35 * MS, spare)]);
    }
    let compared = |bench: &Bench| {
        let spare = bench.selection.candidates(bench.now_ns).pop().unwrap();
        (spare.compared, spare.agreed)
    };
    assert_eq!(compared(&bench), (0, 0));
    for i in 20..30 {
        bench.frame_seen(i * PERIOD, &[("main", 30 * MS, seen), ("spare", 35 * MS, None)]);
    }
    assert_eq!(compared(&bench), (10, 0));
    for i in 30..40 {
        bench.frame_seen(i * PERIOD, &[("spare", 20 * MS, seen), ("main", 30 * MS, seen)]);
    }
    assert_eq!(compared(&bench), (20, 10));
}

#[test]
fn a_word_from_before_its_end_brings_no_detector_back() {
    let mut bench = Bench::new(preferring(None, None));
    bench.frames(0..10, &BOTH[..1]);
    bench.gone("main");
    assert!(bench.selection.is_blind());
    bench.selection.received(bench.now_ns + MS, "main", bench.now_ns - MS, None);
    assert!(bench.selection.is_blind());
    bench.selection.received(bench.now_ns + 90 * MS, "main", bench.now_ns + 50 * MS, None);
    assert!(!bench.selection.is_blind());
}

#[test]
fn those_that_left_are_forgotten_and_a_flood_of_names_is_bounded() {
    let mut selection = preferring(None, None);
    selection.received(0, "main", 0, None);
    assert!(!selection.is_blind());
    selection.presence(1, "main", false);
    assert!(selection.is_blind());
    selection.tick(11_000 * MS);
    assert!(selection.active().is_none() && selection.candidates(0).is_empty());
    for i in 0..1000 {
        selection.received(i, &format!("d{i}"), i, None);
    }
    assert_eq!(selection.candidates(0).len(), MAX_DETECTORS);
    assert!(!selection.received(1000, "main", 1000, None), "there is no room");
    let later = 61_000 * MS;
    selection.tick(later);
    assert!(!selection.received(later, &"d".repeat(65), later, None), "no name of a service");
    assert!(selection.received(later, "main", later, None));
}

/// The marker 5 m below, displaced to the north.
fn at(north_m: f64) -> Option<Sight> {
    Some(place([north_m, 0.0, 5.0]))
}

/// The first time at which a warning of the detectors has this word, in milliseconds.
fn warned_ms(
    bench: &mut Bench,
    frames: std::ops::Range<i64>,
    answers: &[(&str, i64, Option<Sight>)],
    word: &str,
) -> Option<i64> {
    let began_ns = frames.start * PERIOD;
    for i in frames {
        bench.frame_seen(i * PERIOD, answers);
        if bench.selection.warnings(bench.now_ns).iter().any(|warning| warning.text.contains(word))
        {
            return Some((bench.now_ns - began_ns) / MS);
        }
    }
    None
}

#[test]
fn two_that_disagree_are_reported_within_a_second_and_until_they_agree_again() {
    let mut bench = Bench::new(preferring(Some("liar"), None));
    let honest = ("main", 30 * MS, at(0.0));
    for i in 0..60 {
        bench.frame_seen(i * PERIOD, &[honest, ("liar", 35 * MS, at(0.02))]);
    }
    assert_eq!(bench.selection.active(), Some("liar"));
    assert_eq!(bench.selection.dispute(), None);
    let lie = ("liar", 35 * MS, at(1.0));
    let took_ms = warned_ms(&mut bench, 60..90, &[honest, lie], "1.00 m apart").unwrap();
    assert!(took_ms < 1000, "{took_ms} ms");
    let dispute = bench.selection.dispute().unwrap().clone();
    assert_eq!((dispute.active.as_str(), dispute.other.as_str()), ("liar", "main"));
    // One that only sees the marker more rarely, or less precisely, disputes nothing.
    for i in 100..140 {
        let rarely = at(0.1).filter(|_| i % 3 == 0);
        bench.frame_seen(i * PERIOD, &[("main", 30 * MS, rarely), ("liar", 35 * MS, at(0.0))]);
    }
    assert_eq!(bench.selection.dispute(), None);
    assert!(bench.selection.warnings(bench.now_ns).is_empty());
}

/// About as far apart as the tolerance allows, noise would end and begin a disagreement with every frame.
#[test]
fn two_that_disagree_in_every_other_frame_do_so_until_they_agree_clearly() {
    let mut bench = Bench::new(preferring(None, None));
    let mut changes = 0;
    let mut is_disputed = false;
    for i in 0..300 {
        let differs = if i < 20 { true } else { (i / 4) % 2 == 0 };
        let other = at(if differs { 0.3 } else { 0.2 });
        bench.frame_seen(i * PERIOD, &[("main", 30 * MS, at(0.0)), ("other", 35 * MS, other)]);
        let now = bench.selection.dispute().is_some();
        changes += u32::from(std::mem::replace(&mut is_disputed, now) != now);
    }
    assert_eq!((changes, is_disputed), (1, true));
    for i in 300..340 {
        bench.frame_seen(i * PERIOD, &[("main", 30 * MS, at(0.0)), ("other", 35 * MS, at(0.2))]);
    }
    assert_eq!(bench.selection.dispute(), None);
}

#[test]
fn a_dispute_lasts_while_both_are_late_or_see_nothing() {
    let mut bench = Bench::new(preferring(None, None));
    for i in 0..20 {
        let answers = [("main", 30 * MS, at(0.0)), ("spare", 35 * MS, at(1.0))];
        bench.frame_seen(i * PERIOD, &answers);
    }
    assert!(bench.selection.dispute().is_some());
    // On a busy machine both are late by turns, and each is the active one for a while.
    for i in 20..80 {
        let late = |is_late: bool| if is_late { 250 * MS } else { 60 * MS };
        let sight = |north_m: f64| at(north_m).filter(|_| i < 50);
        let main = ("main", late(i / 10 % 2 == 0), sight(0.0));
        let spare = ("spare", late(i / 10 % 2 == 1), sight(1.0));
        bench.frame_seen(i * PERIOD, &[main, spare]);
        assert!(bench.selection.dispute().is_some(), "frame {i}");
    }
    for i in 80..120 {
        let answers = [("main", 30 * MS, at(0.0)), ("spare", 35 * MS, at(0.02))];
        bench.frame_seen(i * PERIOD, &answers);
    }
    assert_eq!(bench.selection.dispute(), None);
}

/// While two agree again, the distance that counted stays in the warning.
#[test]
fn a_dispute_that_fades_states_the_distance_of_the_frames_that_differ() {
    let mut bench = Bench::new(preferring(None, None));
    let seen = |north_m: f64| [("main", 30 * MS, at(0.0)), ("other", 35 * MS, at(north_m))];
    for i in 0..20 {
        bench.frame_seen(i * PERIOD, &seen(1.0));
    }
    let mut disputed = 0;
    for i in 20..40 {
        bench.frame_seen(i * PERIOD, &seen(0.0));
        disputed += bench.selection.dispute().map_or(0, |dispute| {
            assert!((dispute.apart_m - 1.0).abs() < 1e-9, "frame {i}: {dispute:?}");
            1
        });
    }
    assert!((1..20).contains(&disputed), "{disputed}");
}

#[test]
fn one_whose_stamps_are_too_old_disputes_nothing_and_outvotes_none() {
    let mut bench = Bench::new(preferring(Some("mine"), None));
    let (old_a, old_b) = (("mine", 3020 * MS, at(4.0)), ("more", 3030 * MS, at(4.0)));
    let mut events = Vec::new();
    for i in 50..200 {
        for (name, late, sight) in [("main", 30 * MS, at(0.0)), old_a, old_b] {
            events.push((i * PERIOD + late, name, i * PERIOD, sight));
        }
    }
    events.sort_by_key(|(at, ..)| *at);
    for (at, name, stamp, sight) in events {
        bench.now_ns = at;
        bench.selection.received(at, name, stamp, sight);
        bench.selection.tick(at);
        bench.note();
        assert_eq!(bench.selection.dispute(), None, "{at}");
        assert!(bench.selection.warnings(at).is_empty(), "{at}");
        if at > 100 * PERIOD && at < 200 * PERIOD {
            assert_eq!(bench.selection.active(), Some("main"), "{at}");
            assert_eq!(bench.state("mine"), DetectorState::Stale, "{at}");
        }
    }
}

/// A detector that becomes late in a dispute leaves it.
#[test]
fn a_dispute_ends_when_one_of_both_is_too_late_to_be_used() {
    let mut bench = Bench::new(preferring(None, None));
    for i in 0..20 {
        bench.frame_seen(i * PERIOD, &[("main", 30 * MS, at(0.0)), ("spare", 35 * MS, at(1.0))]);
    }
    assert!(bench.selection.dispute().is_some());
    for i in 20..40 {
        bench.frame_seen(i * PERIOD, &[("main", 30 * MS, at(0.0))]);
        let stamp_ns = i * PERIOD - 700 * MS;
        bench.selection.received(bench.now_ns, "spare", stamp_ns, at(1.0));
    }
    bench.selection.tick(bench.now_ns);
    assert_eq!(bench.selection.dispute(), None);
}

/// Runs detectors that search frames of a camera with 30 Hz, each every so many frames and with its latency.
fn searched_at_rates(
    bench: &mut Bench,
    frames: std::ops::Range<i64>,
    answers: &[(&str, i64, i64, Option<Sight>)],
) {
    let period = 33 * MS;
    let ended_ns = frames.end * period;
    let ticks = (frames.start * period..ended_ns).step_by(25 * MS as usize);
    let mut events: Vec<_> = ticks.map(|at| (at, None)).collect();
    for (name, every, late, sight) in answers {
        let searched = frames.clone().filter(|i| i % every == 0);
        events.extend(searched.map(|i| (i * period + late, Some((*name, i * period, *sight)))));
    }
    events.retain(|(at, _)| *at <= ended_ns);
    events.sort_by_key(|(at, _)| *at);
    for (at, event) in events {
        bench.now_ns = bench.now_ns.max(at);
        match event {
            Some((name, stamp, sight)) => {
                bench.selection.received(bench.now_ns, name, stamp, sight);
            }
            None => bench.selection.tick(bench.now_ns),
        }
        bench.note();
    }
}

#[test]
fn detectors_of_different_rate_and_latency_are_compared_as_well() {
    for (every, late) in [(3, 300 * MS), (6, 500 * MS), (10, 100 * MS)] {
        // Two that differ.
        let mut bench = Bench::new(preferring(None, None));
        let [quick, slow] = [("quick", 1, 30 * MS), ("slow", every, 30 * MS + late)];
        let seen = |(name, every, late): (_, _, _), sight| (name, every, late, sight);
        searched_at_rates(&mut bench, 0..150, &[seen(quick, at(0.0)), seen(slow, at(1.0))]);
        assert!(bench.selection.dispute().is_some(), "{every} {late}");
        // Until they agree.
        searched_at_rates(&mut bench, 150..300, &[seen(quick, at(0.0)), seen(slow, at(0.0))]);
        assert_eq!(bench.selection.dispute(), None, "{every} {late}");
        // A preferred one that sees nothing.
        let mut bench = Bench::new(preferring(Some("quick"), None));
        searched_at_rates(&mut bench, 0..150, &[seen(quick, None), seen(slow, at(0.0))]);
        assert_eq!(bench.state("quick"), DetectorState::Blind, "{every} {late}");
        // Of three the odd one.
        let mut bench = Bench::new(preferring(Some("quick"), None));
        let second = ("second", every, 40 * MS + late, at(0.0));
        searched_at_rates(&mut bench, 0..150, &[seen(quick, at(1.0)), seen(slow, at(0.0)), second]);
        assert_eq!(bench.state("quick"), DetectorState::Outvoted, "{every} {late}");
    }
}

#[test]
fn a_dispute_outlasts_the_silence_of_one_of_both_and_ends_when_it_is_stopped() {
    for silent in ["main", "spare"] {
        let mut bench = Bench::new(preferring(None, None));
        let all = [("main", 30 * MS, at(0.0)), ("spare", 35 * MS, at(1.0))];
        for i in 0..20 {
            bench.frame_seen(i * PERIOD, &all);
        }
        assert!(bench.selection.dispute().is_some());
        let other: Vec<_> = all.into_iter().filter(|(name, ..)| *name != silent).collect();
        for i in 20..80 {
            bench.frame_seen(i * PERIOD, &other);
            assert!(bench.selection.dispute().is_some(), "{silent}, frame {i}");
        }
        for i in 80..90 {
            bench.frame_seen(i * PERIOD, &all);
            assert!(bench.selection.dispute().is_some(), "{silent}, frame {i}");
        }
        bench.gone(silent);
        bench.frame_seen(90 * PERIOD, &other);
        assert_eq!(bench.selection.dispute(), None, "{silent}");
    }
    // One without any further message, not even of its end, is forgotten.
    let mut bench = Bench::new(preferring(None, None));
    for i in 0..20 {
        bench.frame_seen(i * PERIOD, &[("main", 30 * MS, at(0.0)), ("spare", 35 * MS, at(1.0))]);
    }
    for i in 20..1000 {
        bench.frame_seen(i * PERIOD, &[("main", 30 * MS, at(0.0))]);
    }
    assert_eq!(bench.selection.dispute(), None);
}

#[test]
fn naming_a_detector_in_a_dispute_decides_it() {
    let mut bench = Bench::new(preferring(None, None));
    let answers = [("main", 30 * MS, at(0.0)), ("spare", 35 * MS, at(1.0))];
    for i in 0..20 {
        bench.frame_seen(i * PERIOD, &answers);
    }
    assert!(bench.selection.dispute().is_some());
    bench.selection.prefer(bench.now_ns, "spare").unwrap();
    for i in 20..40 {
        bench.frame_seen(i * PERIOD, &answers);
    }
    assert_eq!((bench.selection.active(), bench.selection.dispute()), (Some("spare"), None));
}

#[test]
fn of_three_the_one_that_sees_the_marker_elsewhere_is_outvoted_even_if_it_is_preferred() {
    let mut bench = Bench::new(preferring(Some("liar"), None));
    let [first, second] = [("first", 30 * MS, at(0.0)), ("second", 25 * MS, at(0.03))];
    for i in 0..60 {
        bench.frame_seen(i * PERIOD, &[first, second, ("liar", 35 * MS, at(0.01))]);
    }
    assert_eq!(bench.selection.active(), Some("liar"));
    let lie = ("liar", 35 * MS, at(1.0));
    let took_ms =
        warned_ms(&mut bench, 60..90, &[first, second, lie], "2 others see the marker").unwrap();
    assert!(took_ms < 1000, "{took_ms} ms");
    for i in 90..150 {
        bench.frame_seen(i * PERIOD, &[first, second, lie]);
    }
    let active = bench.selection.active().unwrap().to_owned();
    assert_ne!(active, "liar");
    assert!(bench.selection.why().contains("liar: 2 others see"), "{}", bench.selection.why());
    assert_eq!((bench.selection.dispute(), bench.state("liar")), (None, DetectorState::Outvoted));
}

/// The marker straight below, its upper edge turned by a quarter.
fn quarter_turned() -> Option<Sight> {
    Some(turned([0.0, 0.0, 5.0], 90.0))
}

impl Bench {
    /// Two that see the marker at one place and a third one that sees it turned, for 60 frames.
    fn two_and_one_turned(&mut self) {
        let answers = [
            ("first", 30 * MS, at(0.0)),
            ("second", 25 * MS, at(0.03)),
            ("turned", 35 * MS, quarter_turned()),
        ];
        for i in 0..60 {
            self.frame_seen(i * PERIOD, &answers);
        }
    }
}

#[test]
fn two_that_see_the_marker_turned_are_reported_and_the_new_one_is_not_trusted() {
    let mut bench = Bench::new(preferring(Some("turned"), None));
    let answers = [("main", 30 * MS, at(0.0)), ("turned", 35 * MS, quarter_turned())];
    let text = "0.00 m apart and turned by 90 degrees";
    let took_ms = warned_ms(&mut bench, 0..30, &answers, text).unwrap();
    assert!(took_ms < 1000, "{took_ms} ms");
    let shadow = bench.selection.candidates(bench.now_ns);
    let shadow = shadow.iter().find(|it| it.state == DetectorState::Shadow).unwrap();
    assert!(shadow.compared >= 8 && shadow.agreed == 0, "{shadow:?}");
    // The turn is reported as long as the dispute persists.
    for i in 30..100 {
        bench.frame_seen(i * PERIOD, &[("main", 30 * MS, None), ("turned", 35 * MS, None)]);
    }
    let dispute = bench.selection.dispute().unwrap();
    assert!((dispute.turned_rad.unwrap().to_degrees() - 90.0).abs() < 1e-9, "{dispute:?}");
    for i in 100..130 {
        bench.frame_seen(i * PERIOD, &[("main", 30 * MS, at(0.0)), ("turned", 35 * MS, at(0.0))]);
    }
    assert_eq!(bench.selection.dispute(), None);
}

#[test]
fn of_three_the_one_that_sees_the_marker_turned_is_outvoted_even_if_it_is_preferred() {
    let mut bench = Bench::new(preferring(Some("turned"), None));
    bench.two_and_one_turned();
    assert_ne!(bench.selection.active(), Some("turned"));
    assert_eq!(bench.state("turned"), DetectorState::Outvoted);
    assert_eq!(bench.selection.dispute(), None);
    let warnings = bench.selection.warnings(bench.now_ns);
    assert!(warnings[0].text.contains("where it does and turned by 90 degrees"), "{warnings:?}");
}

#[test]
fn where_the_vehicle_does_not_turn_to_the_marker_its_heading_does_not_matter() {
    let usual = limits();
    let tolerance = Tolerance { heading_rad: None, ..usual.tolerance };
    let limits = Limits { tolerance, ..usual };
    let mut bench = Bench::new(Selection::new(limits, Preference::default()));
    bench.two_and_one_turned();
    assert_eq!((bench.selection.dispute(), bench.state("turned")), (None, DetectorState::Shadow));
    assert!(bench.selection.warnings(bench.now_ns).is_empty());
    let turned = bench.selection.candidates(bench.now_ns);
    let turned = turned.iter().find(|it| it.detector == "turned").unwrap();
    assert_eq!(turned.agreed, turned.compared);
}

#[test]
fn a_preferred_one_that_sees_nothing_is_passed_over_and_reported() {
    let mut bench = Bench::new(preferring(Some("blind"), None));
    let answers = [("main", 30 * MS, at(0.0)), ("blind", 20 * MS, None)];
    let took_ms = warned_ms(&mut bench, 0..40, &answers, "`blind` is passed over").unwrap();
    assert!(took_ms < 1500, "{took_ms} ms");
    for i in 40..120 {
        bench.frame_seen(i * PERIOD, &answers);
    }
    assert_eq!((bench.selection.active(), bench.selection.dispute()), (Some("main"), None));
    // It answers in time, and is not stale.
    assert_eq!(bench.state("blind"), DetectorState::Blind);
    // Where none sees the marker, none is blind.
    for i in 120..240 {
        bench.frame_seen(i * PERIOD, &[("main", 30 * MS, None), ("blind", 20 * MS, None)]);
    }
    assert!(bench.selection.warnings(bench.now_ns).is_empty());
    assert_eq!(bench.selection.active(), Some("blind"));
}

/// Answers in which the first detector gives no pose, or gives one without a known position in the body frame.
fn without_position(has_pose: bool) -> Option<Sight> {
    Some(Sight { position_m: None, heading_rad: None, has_pose })
}

#[test]
fn one_that_gives_no_pose_is_reported_and_gives_way_to_one_that_does() {
    for preferred in [None, Some("mine")] {
        let mut bench = Bench::new(preferring(preferred, None));
        let mine = ("mine", 20 * MS, without_position(false));
        let took_ms = warned_ms(&mut bench, 0..40, &[mine], "`mine` gives no pose").unwrap();
        assert!(took_ms < 1000, "{took_ms} ms");
        let text = bench.selection.no_pose(bench.now_ns).unwrap();
        let parts = ["`mine` gives no pose", "in three or more of four", "FAMILY:ID:SIZE_M"];
        assert!(parts.iter().all(|part| text.contains(part)), "{text}");
        assert_eq!(bench.state("mine"), DetectorState::NoPose);
        assert_eq!(bench.selection.active(), Some("mine"), "there is no other");
        for i in 40..60 {
            bench.frame_seen(i * PERIOD, &[mine, ("main", 30 * MS, at(0.0))]);
        }
        assert_eq!(bench.selection.active(), Some("main"));
        let why = bench.selection.why().to_owned();
        assert!(why.contains("mine: it gives no pose"), "{why}");
        assert_eq!(
            (bench.selection.no_pose(bench.now_ns), bench.selection.dispute()),
            (None, None)
        );
        let answer = bench.selection.prefer(bench.now_ns, "mine").unwrap();
        assert!(answer.contains("as soon as it is healthy; now it gives no pose"), "{answer}");
        // Its camera is calibrated now.
        for i in 60..140 {
            let answers = [("mine", 20 * MS, at(0.0)), ("main", 30 * MS, at(0.0))];
            bench.frame_seen(i * PERIOD, &answers);
        }
        assert_eq!(bench.selection.active(), Some("mine"));
        assert!(bench.selection.warnings(bench.now_ns).is_empty());
    }
}

#[test]
fn poses_are_missed_only_where_the_landing_needs_them_and_the_detector_gives_none() {
    for (needs_pose, has_pose) in [(false, false), (true, true)] {
        let limits = Limits { needs_pose, ..limits() };
        let preference = Preference { detector: None, place: None };
        let mut bench = Bench::new(Selection::new(limits, preference));
        for i in 0..40 {
            bench.frame_seen(i * PERIOD, &[("mine", 20 * MS, without_position(has_pose))]);
        }
        assert!(bench.selection.warnings(bench.now_ns).is_empty());
        assert_eq!(bench.state("mine"), DetectorState::Active);
    }
}

#[test]
fn names_are_replaced_by_better_ones_only() {
    let mut bench = Bench::new(preferring(Some("preferred"), None));
    let names: Vec<String> = (0..70).map(|i| format!("invented{i}")).collect();
    for name in &names {
        bench.selection.presence(0, name, true);
    }
    let invented: Vec<_> = names.iter().map(|name| (name.as_str(), 10 * MS, None)).collect();
    let mut all = invented.clone();
    all.push(("main", 30 * MS, at(0.0)));
    for i in 0..40 {
        bench.frame_seen(i * PERIOD, &all);
    }
    assert_eq!(
        bench.selection.active(),
        Some("main"),
        "it sees the marker, the invented ones do not"
    );
    assert!(
        bench
            .selection
            .warnings(bench.now_ns)
            .iter()
            .any(|warning| warning.text.contains("ignored"))
    );
    // It starts again, and the preferred one comes.
    bench.gone("main");
    for i in 40..70 {
        bench.frame_seen(i * PERIOD, &invented);
    }
    assert!(bench.selection.candidates(bench.now_ns).len() <= MAX_DETECTORS);
    all.push(("preferred", 35 * MS, at(0.0)));
    for i in 70..120 {
        bench.frame_seen(i * PERIOD, &all);
    }
    assert_eq!(bench.selection.active(), Some("preferred"));
}

/// The possible events, after some time.
#[derive(Clone, Debug)]
enum Step {
    Received { detector: usize, stamp_ago_ms: i64, seen: bool },
    Presence { detector: usize, alive: bool },
    Prefer { detector: usize },
    Place { ground: bool },
    Tick,
}

fn step() -> impl Strategy<Value = (i64, Step)> {
    let event = prop_oneof![
        6 => (0..5_usize, -20..400_i64, any::<bool>())
            .prop_map(|(detector, stamp_ago_ms, seen)| Step::Received { detector, stamp_ago_ms, seen }),
        1 => (0..5_usize, any::<bool>()).prop_map(|(detector, alive)| Step::Presence { detector, alive }),
        1 => (0..5_usize).prop_map(|detector| Step::Prefer { detector }),
        1 => any::<bool>().prop_map(|ground| Step::Place { ground }),
        3 => Just(Step::Tick),
    ];
    (0..120_i64, event)
}

const NAMES: [&str; 5] = ["a", "b", "c", "d", "e"];

proptest! {
    #[test]
    fn whatever_happens_stamps_only_grow_and_the_active_one_is_known(
        steps in prop::collection::vec(step(), 1..400),
    ) {
        let mut bench = Bench::new(preferring(None, None));
        // Those that may be present: a message arrived since they were last reported as gone.
        let mut present = [false; NAMES.len()];
        for (wait_ms, event) in steps {
            bench.now_ns += wait_ms * MS;
            let now = bench.now_ns;
            match event {
                Step::Received { detector, stamp_ago_ms, seen } => {
                    present[detector] = true;
                    let sight = seen.then_some(place([0.0, 0.0, 3.0]));
                    bench.selection.received(now, NAMES[detector], now - stamp_ago_ms * MS, sight);
                }
                Step::Presence { detector, alive } => {
                    present[detector] = alive;
                    bench.selection.presence(now, NAMES[detector], alive);
                }
                Step::Prefer { detector } => drop(bench.selection.prefer(now, NAMES[detector])),
                Step::Place { ground } => {
                    let place = if ground { Place::Ground } else { Place::Onboard };
                    present[index_of(place)] = true;
                    bench.selection.set_place(now, NAMES[index_of(place)], place);
                    bench.selection.prefer_place(now, place);
                }
                Step::Tick => bench.selection.tick(now),
            }
            bench.note();
            let active = bench.selection.active();
            prop_assert!(active.is_none_or(|name| bench.selection.knows(name)));
            let is_blind = bench.selection.is_blind();
            prop_assert!(!is_blind || bench.selection.candidates(now).iter().all(|c| !c.alive));
            prop_assert!(is_blind || present.contains(&true), "all are gone");
        }
    }

    #[test]
    fn without_orders_a_preferred_one_that_comes_and_goes_causes_few_changes(
        spells in prop::collection::vec((1..60_i64, 1..40_i64), 5..40),
    ) {
        let mut bench = Bench::new(preferring(Some("main"), None));
        let mut frame = 0;
        for (well, silent) in spells {
            bench.frames(frame..frame + well, &BOTH);
            bench.frames(frame + well..frame + well + silent, &BOTH[1..]);
            frame += well + silent;
        }
        // The delays double from 2 s: in any 30 s there are few returns, each after its delay.
        for (i, (at, name)) in bench.changes.iter().enumerate().skip(2) {
            if name == "main" {
                prop_assert!(at - bench.changes[i - 1].0 >= 2_000 * MS - PERIOD, "{:?}", bench.changes);
            }
            let before = bench.changes.iter().filter(|(then, _)| (0..30_000 * MS).contains(&(at - then))).count();
            prop_assert!(before <= 12, "{:?}", bench.changes);
        }
        // The other one is always there, so no gap is long; the period of one with rare messages
        // looks longer than it is, but a silence has an end.
        let longest_ms = (MAX_SILENCE_NS + 2 * PERIOD) / MS;
        prop_assert!(bench.longest_gap_ms() <= longest_ms, "{} ms", bench.longest_gap_ms());
    }
}

fn index_of(place: Place) -> usize {
    match place {
        Place::Onboard => 0,
        Place::Ground => 1,
    }
}
