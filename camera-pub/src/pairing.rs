//! Pairs each frame of a camera's program with its record of metadata by arrival, number and delay, for its stamp. A frame
//! whose record is in doubt gets none.
//!
//! A program writes a frame and then, at once, its metadata, on two channels. Three things must agree before a record stamps a frame:
//! the record arrived after the frame began and before the next one did; both have the same number, counted since the start; and the
//! time from the record's stamp to the frame's arrival is that of the frames before. Once that time is known, a frame's record is
//! found by it also where lines were lost or doubled, and where it changes permanently, as with a busy processor, it is learnt
//! again from records with their frames' numbers.

use crate::exposure::{Exposure, Shutter};
use crate::metadata::{Metadata, Record};

/// Number of frames in a row whose records must agree before one is used.
const AGREEING_FRAMES: u32 = 5;
/// Number of records in a row with a stamp that cannot be their frame's after which the clock is refused.
const IMPOSSIBLE_RECORDS: u32 = 5;
/// Maximum time from a frame's stamp to its arrival. A longer one is not of a camera but of another clock.
const MAX_DELAY_NS: i64 = 1_000_000_000;
/// Maximum number of records that wait for their frame; older ones are dropped.
const MAX_WAITING: usize = 16;
/// Weight of a new frame's delay in the mean.
const DELAY_WEIGHT: i64 = 8;

/// Finds each frame's record.
pub(crate) struct Pairing {
    shutter: Shutter,
    period_ns: i64,
    /// The offset that is added to the program's stamps to convert them to the host's clock: one of these, until one is chosen.
    clock_offsets_ns: Vec<i64>,
    /// Number of records so far, torn ones among them.
    records: i64,
    /// Number of frames so far.
    frames: i64,
    /// Number of records before the first frame's: 0 at the start, and as many more as there were doubled ones.
    shift: i64,
    /// The stamp of the newest record.
    last_sensor_ns: i64,
    waiting: Vec<Numbered>,
    /// Time from a frame's stamp to its arrival; `None` until frames and records agree.
    delay_ns: Option<i64>,
    candidate: Option<Candidate>,
    /// For so many frames only a record with the frame's own number is its: one did not have the known delay of late.
    doubtful: u32,
    impossible: u32,
}

/// A record, and which of the stream it is.
#[derive(Copy, Clone)]
struct Numbered {
    number: i64,
    /// The frame in which, or just before which, it was read.
    read_in: i64,
    metadata: Metadata,
}

/// A delay that may become the known one.
#[derive(Copy, Clone)]
struct Candidate {
    delay_ns: i64,
    frames: u32,
}

/// A record on the host's clock.
#[derive(Copy, Clone)]
struct Placed {
    number: i64,
    read_in: i64,
    metadata: Metadata,
    stamp_ns: i64,
    delay_ns: i64,
}

/// A program's stamps are of a clock that is not the host's.
#[derive(Copy, Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "the metadata stamp frames {:.3} s before they arrive (0 to {:.0} s are possible): SensorTimestamp is not of this \
     machine's clock since its start (CLOCK_BOOTTIME or CLOCK_MONOTONIC); take `{{metadata}}` out of `source.command`, \
     and set `source.delay_ms`",
    *before_arrival_ns as f64 * 1e-9,
    MAX_DELAY_NS as f64 * 1e-9
)]
pub(crate) struct ForeignClock {
    before_arrival_ns: i64,
}

impl Pairing {
    /// `boot_ahead_ns` is by how much the clock that counts while the machine sleeps (CLOCK_BOOTTIME) is ahead of the
    /// host's. libcamera documents that clock; its drivers may stamp with the other one.
    pub(crate) fn new(shutter: Shutter, period_ns: i64, boot_ahead_ns: i64) -> Self {
        Self {
            shutter,
            period_ns,
            clock_offsets_ns: vec![-boot_ahead_ns, 0],
            records: 0,
            frames: 0,
            shift: 0,
            last_sensor_ns: 0,
            waiting: Vec::new(),
            delay_ns: None,
            candidate: None,
            doubtful: 0,
            impossible: 0,
        }
    }

    /// No frame has begun to arrive since the last one ended: the records that are there are not of the next one, as programs write
    /// them after their frames.
    pub(crate) fn forget_unmatched(&mut self) {
        if self.delay_ns.is_none() {
            self.waiting.clear();
        }
        for record in &mut self.waiting {
            record.read_in = record.read_in.min(self.frames - 1);
        }
    }

    /// Takes a record.
    pub(crate) fn add(&mut self, record: Record) {
        if let Record::Complete(metadata) = record {
            if metadata.sensor_ns == self.last_sensor_ns {
                // Doubled: not one more.
                return;
            }
            self.last_sensor_ns = metadata.sensor_ns;
            if self.waiting.len() == MAX_WAITING {
                self.waiting.remove(0);
            }
            let (number, read_in) = (self.records, self.frames);
            self.waiting.push(Numbered { number, read_in, metadata });
        }
        self.records += 1;
    }

    /// True when no other record need be waited for.
    pub(crate) fn is_settled(&self, arrival_ns: i64) -> bool {
        match self.delay_ns {
            Some(_) => self.matching(arrival_ns).is_some(),
            None => !self.waiting.is_empty(),
        }
    }

    /// True once frames and records agree.
    pub(crate) fn has_agreed(&self) -> bool {
        self.delay_ns.is_some()
    }

    /// The exposure of the frame that arrived at `arrival_ns`; `None` when its record is missing or in doubt.
    ///
    /// # Errors
    /// All records are of a clock that is not the host's.
    pub(crate) fn end_frame(&mut self, arrival_ns: i64) -> Result<Option<Exposure>, ForeignClock> {
        self.check_clock(arrival_ns)?;
        let matching = self.matching(arrival_ns);
        match matching {
            Some(placed) => {
                let known_ns = self.delay_ns.unwrap_or(placed.delay_ns);
                self.delay_ns = Some(known_ns + (placed.delay_ns - known_ns) / DELAY_WEIGHT);
                self.shift = placed.number - self.frames;
                self.candidate = None;
                self.doubtful = 0;
            }
            None => {
                self.doubtful = self.doubtful.saturating_sub(1);
                self.learn(arrival_ns);
            }
        }
        match matching {
            Some(placed) => {
                let used_ns = placed.metadata.sensor_ns;
                self.waiting.retain(|record| record.metadata.sensor_ns > used_ns);
            }
            None if self.delay_ns.is_none() => self.waiting.clear(),
            None => {}
        }
        self.frames += 1;
        Ok(matching.map(|placed| {
            let exposure_ns = placed.metadata.exposure_ns;
            let mid_ns = self.shutter.mid_exposure_ns(placed.stamp_ns, exposure_ns);
            Exposure { mid_ns, exposure_ns }
        }))
    }

    /// A frame that was queued has arrived: the records written meanwhile do not show when.
    pub(crate) fn skip_frame(&mut self) {
        self.frames += 1;
        self.candidate = None;
        self.doubtful = AGREEING_FRAMES;
    }

    /// The record that belongs to the frame, if there is no doubt.
    fn matching(&self, arrival_ns: i64) -> Option<Placed> {
        let known_ns = self.delay_ns?;
        let of_frame = |placed: &Placed| {
            // The records of two frames are a period apart. A number that agrees decides for records that are nearly half a
            // period off.
            let is_next = placed.number - self.frames == self.shift;
            let max_ns = if is_next { self.period_ns / 5 * 2 } else { self.period_ns / 4 };
            let may_be_its = placed.read_in >= self.frames && (is_next || self.doubtful == 0);
            may_be_its && (placed.delay_ns - known_ns).abs() <= max_ns
        };
        let mut found = self.possible(arrival_ns).filter(of_frame);
        let first = found.next();
        first.filter(|_| found.next().is_none())
    }

    /// The records that may be of a frame that arrived then.
    fn possible(&self, arrival_ns: i64) -> impl Iterator<Item = Placed> {
        let offset_ns = self.clock_offsets_ns.first().copied().unwrap_or(0);
        self.waiting.iter().filter_map(move |record| {
            let Numbered { number, read_in, metadata } = *record;
            let stamp_ns = metadata.sensor_ns.checked_add(offset_ns)?;
            let delay_ns = arrival_ns.checked_sub(stamp_ns)?;
            let min_ns = self.shutter.until_read_ns(metadata.exposure_ns);
            let is_possible = (min_ns..=MAX_DELAY_NS).contains(&delay_ns);
            is_possible.then_some(Placed { number, read_in, metadata, stamp_ns, delay_ns })
        })
    }

    /// Counts a frame towards a delay that several agree on. While none is known there must be no other record; a known one is
    /// given up for another.
    fn learn(&mut self, arrival_ns: i64) {
        let is_alone = self.waiting.len() == 1 || self.delay_ns.is_some();
        let own = |placed: &Placed| {
            placed.number - self.frames == self.shift && placed.read_in >= self.frames
        };
        let own = self.possible(arrival_ns).find(own).filter(|_| is_alone);
        let Some(placed) = own else {
            self.candidate = None;
            return;
        };
        self.doubtful = AGREEING_FRAMES;
        let agreeing = self
            .candidate
            .filter(|candidate| (placed.delay_ns - candidate.delay_ns).abs() <= self.period_ns / 4);
        let delay_ns = placed.delay_ns;
        let first = Candidate { delay_ns, frames: 0 };
        let Candidate { delay_ns, frames } = agreeing.unwrap_or(first);
        self.candidate = Some(Candidate { delay_ns, frames: frames + 1 });
        if frames + 1 == AGREEING_FRAMES {
            self.delay_ns = Some(delay_ns);
        }
    }

    /// Finds on which clock the stamps are, and refuses them when they are on none.
    fn check_clock(&mut self, arrival_ns: i64) -> Result<(), ForeignClock> {
        if self.delay_ns.is_some() || self.waiting.is_empty() {
            return Ok(());
        }
        if self.possible(arrival_ns).next().is_some() {
            self.impossible = 0;
            return Ok(());
        }
        self.impossible += 1;
        if self.impossible < IMPOSSIBLE_RECORDS {
            return Ok(());
        }
        let offset_ns = self.clock_offsets_ns.first().copied().unwrap_or(0);
        if self.clock_offsets_ns.len() > 1 {
            self.clock_offsets_ns.remove(0);
            self.impossible = 0;
            return Ok(());
        }
        let stamps = self.waiting.iter().map(|record| record.metadata.sensor_ns);
        let stamp_ns = stamps.max().unwrap_or(0).saturating_add(offset_ns);
        Err(ForeignClock { before_arrival_ns: arrival_ns.saturating_sub(stamp_ns) })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::exposure::StampedAt;
    use proptest::prelude::*;

    const MS: i64 = 1_000_000;
    const PERIOD_NS: i64 = 40 * MS;
    const DELAY_NS: i64 = 70 * MS;
    const EXPOSURE_NS: u32 = 4_000_000;
    const SHUTTER: Shutter =
        Shutter { stamped_at: StampedAt::ReadoutStart, readout_ns: 20_000_000 };

    /// The fault of a line of the metadata.
    #[derive(Copy, Clone, Debug, PartialEq)]
    enum Line {
        Good,
        /// It is written so much later.
        Late(i64),
        Torn,
        Doubled,
        /// Twice, the second time cut.
        DoubledAndTorn,
        Lost,
        /// Digits of its stamp are damaged.
        WrongStamp(i64),
    }

    /// A stream of frames, and the record that is read for each.
    struct Stream {
        /// By how much each frame arrives late.
        late_ns: Vec<i64>,
        lines: Vec<Line>,
    }

    struct Outcome {
        /// Of each frame: how far its stamp is from the truth; `None` where it is not stamped.
        errors_ns: Vec<Option<i64>>,
    }

    impl Outcome {
        fn wrong(&self) -> usize {
            self.errors_ns.iter().flatten().filter(|error| error.abs() > MS).count()
        }

        fn stamped(&self) -> usize {
            self.errors_ns.iter().flatten().count()
        }
    }

    impl Stream {
        fn of(lines: Vec<Line>) -> Self {
            let late_ns = (0..lines.len() as i64).map(|n| (n * 7 % 5) * MS).collect();
            Self { late_ns, lines }
        }

        fn sensor_ns(n: i64) -> i64 {
            1_000_000_000 + n * PERIOD_NS
        }

        /// Reads the stream as the service does: the records that arrive before a frame, and until a little after it.
        fn read(&self) -> Outcome {
            let arrival_ns = |n: i64| Self::sensor_ns(n) + DELAY_NS + self.late_ns[n as usize];
            let mut written = Vec::new();
            for (n, line) in self.lines.iter().enumerate() {
                let n = n as i64;
                let at_ns = arrival_ns(n) + 3 * MS;
                let metadata = Metadata {
                    sensor_ns: Self::sensor_ns(n),
                    exposure_ns: EXPOSURE_NS,
                    gain: None,
                };
                let whole = Record::Complete(metadata);
                match *line {
                    Line::Good => written.push((at_ns, whole)),
                    Line::Late(late_ns) => written.push((at_ns + late_ns, whole)),
                    Line::Torn => written.push((at_ns, Record::Torn)),
                    Line::Doubled => written.extend([(at_ns, whole), (at_ns, whole)]),
                    Line::DoubledAndTorn => written.extend([(at_ns, whole), (at_ns, Record::Torn)]),
                    Line::Lost => {}
                    Line::WrongStamp(by_ns) => {
                        let sensor_ns = metadata.sensor_ns + by_ns;
                        written.push((at_ns, Record::Complete(Metadata { sensor_ns, ..metadata })));
                    }
                }
            }
            // Lines keep their order: a late line delays those behind it.
            for n in 1..written.len() {
                written[n].0 = written[n].0.max(written[n - 1].0);
            }
            let mut pairing = Pairing::new(SHUTTER, PERIOD_NS, 0);
            let mut written = written.into_iter().peekable();
            let mut errors_ns = Vec::new();
            for n in 0..self.lines.len() as i64 {
                let arrival_ns = arrival_ns(n);
                while let Some((_, record)) = written.next_if(|(at, _)| *at < arrival_ns) {
                    pairing.add(record);
                    pairing.forget_unmatched();
                }
                while let Some((_, record)) = written.next_if(|(at, _)| *at < arrival_ns + 8 * MS) {
                    pairing.add(record);
                }
                let exposure = pairing.end_frame(arrival_ns).unwrap();
                let truth_ns = Self::sensor_ns(n) - i64::from(EXPOSURE_NS) / 2 + 10 * MS;
                errors_ns.push(exposure.map(|exposure| exposure.mid_ns - truth_ns));
            }
            Outcome { errors_ns }
        }
    }

    /// The program takes longer or less long for a frame from the thirtieth on.
    #[test]
    fn a_delay_that_changes_for_good_is_learnt_again() {
        for tenths in [-12, -10, -9, -8, -5, 5, 8, 10, 12_i64] {
            let step_ns = tenths * PERIOD_NS / 10;
            let late_ns = |n: i64| {
                let before_ns = (-step_ns).max(0);
                n * 7 % 3 * MS + if n < 30 { before_ns } else { before_ns + step_ns }
            };
            let outcome =
                Stream { late_ns: (0..80).map(late_ns).collect(), lines: vec![Line::Good; 80] }
                    .read();
            assert_eq!(outcome.wrong(), 0, "{tenths}: {:?}", outcome.errors_ns);
            let again = outcome.errors_ns.iter().skip(40).flatten().count();
            assert!(again >= 38, "{tenths}: {:?}", outcome.errors_ns);
        }
    }

    fn with(faults: &[(usize, Line)]) -> Vec<Line> {
        let mut lines = vec![Line::Good; 60];
        for (at, line) in faults {
            lines[*at] = *line;
        }
        lines
    }

    /// Ten kinds of damage: how many frames they leave without a stamp, besides the first ones.
    #[test]
    fn damaged_metadata_never_stamp_another_frame() {
        use Line::{Doubled, DoubledAndTorn, Good, Late, Lost, Torn, WrongStamp};
        let all = |line| (20..60).map(|n| (n, line)).collect::<Vec<_>>();
        let cases = [
            ("whole", with(&[]), 0),
            ("one lost", with(&[(20, Lost)]), 1),
            ("three in a row lost", with(&[(20, Lost), (21, Lost), (22, Lost)]), 3),
            ("one torn", with(&[(20, Torn)]), 1),
            ("one doubled", with(&[(20, Doubled)]), 0),
            ("one doubled, the second torn", with(&[(20, DoubledAndTorn)]), 0),
            ("one late by 20 ms", with(&[(20, Late(20 * MS))]), 1),
            ("one late by a period", with(&[(20, Late(PERIOD_NS))]), 1),
            (
                "one late by three periods, those behind it too",
                with(&[(20, Late(3 * PERIOD_NS))]),
                3,
            ),
            ("all late by a period from then on", with(&all(Late(PERIOD_NS))), 40),
            ("one a period behind", with(&[(20, WrongStamp(-PERIOD_NS / 2))]), 1),
            ("one an hour ahead", with(&[(20, WrongStamp(3_600_000 * MS))]), 1),
            ("lost and doubled", with(&[(20, Lost), (22, Doubled), (24, Torn)]), 2),
            ("the first one lost", with(&[(0, Lost)]), 55),
            ("all late by a period", vec![Late(PERIOD_NS); 60], 55),
            ("the first one doubled and torn", with(&[(0, DoubledAndTorn)]), 55),
            ("none", vec![Lost; 60], 55),
            ("whole, but the first is torn", with(&[(0, Torn)]), 1),
            ("good again", with(&[(5, Good)]), 0),
        ];
        for (name, lines, unstamped) in cases {
            let outcome = Stream::of(lines).read();
            assert_eq!(outcome.wrong(), 0, "{name}: {:?}", outcome.errors_ns);
            let expected = 60 - AGREEING_FRAMES as usize - unstamped;
            assert_eq!(outcome.stamped(), expected, "{name}: {:?}", outcome.errors_ns);
        }
    }

    #[test]
    fn the_clock_is_found_or_refused() {
        let boot_ahead_ns = 7_200_000 * MS;
        let read = |ahead_ns: i64| {
            let mut pairing = Pairing::new(SHUTTER, PERIOD_NS, boot_ahead_ns);
            let mut stamped = 0;
            for n in 0..20 {
                let sensor_ns = Stream::sensor_ns(n) + ahead_ns;
                let exposure_ns = EXPOSURE_NS;
                pairing.add(Record::Complete(Metadata { sensor_ns, exposure_ns, gain: None }));
                let exposure = pairing.end_frame(Stream::sensor_ns(n) + DELAY_NS)?;
                let truth_ns = Stream::sensor_ns(n) - 2 * MS + 10 * MS;
                assert!(exposure.is_none_or(|exposure| exposure.mid_ns == truth_ns));
                stamped += usize::from(exposure.is_some());
            }
            Ok(stamped)
        };
        assert_eq!(read(boot_ahead_ns), Ok(15));
        // Four frames more, until it is plain that the stamps are of the other clock.
        assert_eq!(read(0), Ok(11));
        let problem = |ahead_ns: i64| {
            let problem: ForeignClock = read(ahead_ns).unwrap_err();
            problem.to_string()
        };
        let future = problem(1_700_000_000_000 * MS);
        assert!(future.contains("stamp frames -1699999999.930 s before they arrive"), "{future}");
        let old = problem(-900 * MS - boot_ahead_ns);
        assert!(old.contains("stamp frames 7200.970 s before they arrive"), "{old}");
    }

    fn any_line() -> impl Strategy<Value = Line> {
        prop_oneof![
            12 => Just(Line::Good),
            1 => (0..3 * PERIOD_NS).prop_map(Line::Late),
            1 => Just(Line::Torn),
            1 => Just(Line::Doubled),
            1 => Just(Line::DoubledAndTorn),
            1 => Just(Line::Lost),
        ]
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(2000))]
        /// Frames that are late by anything, and any damage to the lines.
        #[test]
        fn no_frame_has_the_stamp_of_another(
            lines in prop::collection::vec(any_line(), 80..81),
            late_ns in prop::collection::vec(
                prop_oneof![8 => 0..4 * MS, 1 => 0..25 * MS], 80..81),
        ) {
            let outcome = Stream { late_ns, lines }.read();
            prop_assert_eq!(outcome.wrong(), 0, "{:?}", outcome.errors_ns);
        }

        /// From a frame on all are later, or sooner, but not so that it comes with the one before; and a line is damaged.
        #[test]
        fn no_frame_has_the_stamp_of_another_while_the_delay_changes(
            fault in (0_usize..80, any_line()),
            mut late_ns in prop::collection::vec(0..4 * MS, 80..81),
            step in (10_usize..60, -28..60_i64),
        ) {
            let (from, step_ms) = step;
            for (n, late_ns) in late_ns.iter_mut().enumerate() {
                *late_ns += (step_ms * MS).max(0) * i64::from(n >= from);
                *late_ns += (-step_ms * MS).max(0) * i64::from(n < from);
            }
            let mut lines = vec![Line::Good; 80];
            lines[fault.0] = fault.1;
            let outcome = Stream { late_ns, lines }.read();
            prop_assert_eq!(outcome.wrong(), 0, "{:?}", outcome.errors_ns);
        }
    }
}
