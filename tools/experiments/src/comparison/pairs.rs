//! Reads the flights of two runs, pairs them by circumstances and seed, and compares the measures of landings: a summary of each run,
//! the differences of the pairs, and a test of their sign. A seed draws the same wind, start and noise in all circumstances, so that its
//! pairs are not independent: it counts as one.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use anyhow::{Context, ensure};
use node::stats::interpolated_quantile as quantile;
use serde::{Deserialize, Serialize};

use crate::landing::outcome::{self, Ending};
use crate::landing::plan::{ONLY_SIZE_COUNTS, only_size_counts};
use crate::landing::table::{median_coverage, median_interval, percentile, sign_test};
use crate::results::FLIGHTS_AS_JSON;

/// A flight, as its row states it.
#[derive(Clone, Debug, Deserialize)]
pub struct Flight {
    /// The name of its circumstances.
    pub cell: String,
    /// Its seed.
    pub seed: u64,
    /// Its vision.
    pub vision: String,
    /// Guidance, marker and further settings.
    pub settings: String,
    /// The version of the program that flew it.
    pub program: String,
    /// How it ended.
    pub ending: Ending,
    /// See the row of a landing.
    pub touchdown_error_m: Option<f64>,
    /// See the row of a landing.
    pub touchdown_speed_m_s: Option<f64>,
    /// See the row of a landing.
    pub touchdown_lateral_speed_m_s: Option<f64>,
    /// See the row of a landing.
    pub time_to_disarm_s: Option<f64>,
}

/// A finished run.
#[derive(Clone, Debug)]
pub struct Run {
    /// Its folder.
    pub folder: PathBuf,
    /// Its flights.
    pub flights: Vec<Flight>,
}

/// A measure of landings; the smaller, the better.
#[derive(Debug)]
pub struct Measure {
    /// The name of its column.
    pub name: &'static str,
    /// Its description, with its unit.
    pub words: &'static str,
    /// Digits that mean something.
    pub digits: usize,
    of: fn(&Flight) -> Option<f64>,
}

/// All of them, in the order of the tables.
pub const MEASURES: [Measure; 4] = [
    Measure {
        name: "touchdown_error_m",
        words: "touchdown error, m",
        digits: 3,
        of: |it| it.touchdown_error_m,
    },
    Measure {
        name: "time_to_disarm_s",
        words: "time to disarm, s",
        digits: 1,
        of: |it| it.time_to_disarm_s,
    },
    Measure {
        name: "touchdown_speed_m_s",
        words: "speed down at touchdown, m/s",
        digits: 2,
        of: |it| it.touchdown_speed_m_s,
    },
    Measure {
        name: "touchdown_lateral_speed_m_s",
        words: "speed sideways at touchdown, m/s",
        digits: 2,
        of: |it| it.touchdown_lateral_speed_m_s,
    },
];

impl Measure {
    /// Its value of a flight that landed.
    pub fn of_landed(&self, flight: &Flight) -> Option<f64> {
        (self.of)(flight).filter(|_| flight.is_landed())
    }
}

impl Flight {
    fn is_landed(&self) -> bool {
        self.ending == Ending::Landed
    }

    fn is_within(&self, metres: f64) -> bool {
        outcome::is_within(self.ending, self.touchdown_error_m, metres)
    }

    /// As the landing experiment counts it.
    fn is_unsafe(&self) -> bool {
        outcome::is_unsafe(
            self.ending,
            self.touchdown_error_m,
            self.touchdown_speed_m_s,
            self.touchdown_lateral_speed_m_s,
        )
    }
}

impl Run {
    /// Reads the run in a folder.
    ///
    /// # Errors
    /// When it has no flights, or not those of landings.
    pub fn read(folder: &Path) -> anyhow::Result<Self> {
        let file = folder.join(FLIGHTS_AS_JSON);
        let text = std::fs::read_to_string(&file).with_context(|| {
            format!(
                "reading {}; is that the folder of `alight experiment landing`?",
                file.display()
            )
        })?;
        let mut flights = Vec::new();
        for (line, row) in text.lines().enumerate() {
            flights.push(serde_json::from_str(row).with_context(|| {
                format!(
                    "line {} of {} is no flight of `alight experiment landing` of this version",
                    line + 1,
                    file.display()
                )
            })?);
        }
        ensure!(!flights.is_empty(), "{} has no flight", file.display());
        Ok(Self { folder: folder.to_owned(), flights })
    }
}

/// Median, 95th percentile and greatest.
#[derive(Copy, Clone, Debug, PartialEq, Serialize)]
pub struct Spread {
    /// Median.
    pub median: f64,
    /// 95th percentile; `None` for fewer than 20 values.
    pub p95: Option<f64>,
    /// The greatest.
    pub worst: f64,
}

impl Spread {
    /// That of some values; `None` of none.
    fn of(values: &[f64]) -> Option<Self> {
        let part = |part| quantile(values, part);
        Some(Self { median: part(0.5)?, p95: percentile(values, 0.95), worst: part(1.0)? })
    }
}

/// One run.
#[derive(Clone, Debug, Serialize)]
pub struct Side {
    /// Its folder.
    pub folder: PathBuf,
    /// The settings of its flights.
    pub settings: Vec<String>,
    /// The versions that flew them.
    pub programs: Vec<String>,
    /// Their vision.
    pub visions: Vec<String>,
    /// Flights that have no partner in the other run.
    pub unpaired: usize,
    /// Its results.
    #[serde(flatten)]
    pub summary: Summary,
}

/// The results of some flights of a run.
#[derive(Clone, Debug, Serialize)]
pub struct Summary {
    /// Number of flights.
    pub flights: usize,
    /// Those that landed.
    pub landed: usize,
    /// Those of them within 0.1 m.
    pub within_100_mm: usize,
    /// Those that were unsafe.
    #[serde(rename = "unsafe")]
    pub dangerous: usize,
    /// Of all those that landed, each measure by its name; `None` where none has it.
    #[serde(flatten)]
    pub measures: BTreeMap<&'static str, Option<Spread>>,
}

impl Summary {
    fn new(flights: &[&Flight]) -> Self {
        let count = |of: &dyn Fn(&Flight) -> bool| flights.iter().filter(|it| of(it)).count();
        let measures = MEASURES.iter().map(|measure| {
            let values: Vec<f64> =
                flights.iter().filter_map(|flight| measure.of_landed(flight)).collect();
            (measure.name, Spread::of(&values))
        });
        Self {
            flights: flights.len(),
            landed: count(&|it| it.is_landed()),
            within_100_mm: count(&|it| it.is_within(0.1)),
            dangerous: count(&|it| it.is_unsafe()),
            measures: measures.collect(),
        }
    }
}

/// Two flights of the same circumstances and seed.
#[derive(Copy, Clone, Debug)]
struct Pair<'a> {
    first: &'a Flight,
    second: &'a Flight,
}

/// A measure of both flights of a pair.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct Point {
    /// The seed of both.
    pub seed: u64,
    /// Of the first run's flight.
    pub first: f64,
    /// Of the second run's flight.
    pub second: f64,
}

/// Pairs of which both landed, in one measure: the values of each run, and the differences, the second run's value minus the first's. Of a
/// seed with several pairs it is the median of its differences.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Difference {
    /// Number of pairs of which both have it.
    pub pairs: usize,
    /// Number of seeds that they have, each with one difference.
    pub seeds: usize,
    /// The values of the first and of the second run in the pairs; `None` where there is none.
    pub runs: [Option<Spread>; 2],
    /// Median of the seeds' differences.
    pub median: Option<f64>,
    /// Its 95 % interval by order statistics; `None` for fewer than six seeds.
    pub interval: Option<[f64; 2]>,
    /// The probability with which such an interval contains the median: 95 % or more.
    pub interval_percent: Option<f64>,
    /// Seeds in which the second run's value is smaller.
    pub smaller: usize,
    /// Seeds in which it is larger.
    pub larger: usize,
    /// Two-sided sign test: how probable so unequal numbers are if neither run tended to the smaller value.
    pub p: f64,
}

impl Difference {
    fn new(values: &[Point]) -> Self {
        let spread = |of: fn(&Point) -> f64| Spread::of(&values.iter().map(of).collect::<Vec<_>>());
        let mut of_seeds: BTreeMap<u64, Vec<f64>> = BTreeMap::new();
        for it in values {
            of_seeds.entry(it.seed).or_default().push(it.second - it.first);
        }
        let differences: Vec<f64> =
            of_seeds.values().filter_map(|of_seed| quantile(of_seed, 0.5)).collect();
        let count = |is: fn(&f64) -> bool| differences.iter().filter(|it| is(it)).count();
        let (smaller, larger) = (count(|it| *it < 0.0), count(|it| *it > 0.0));
        Self {
            pairs: values.len(),
            seeds: differences.len(),
            runs: [spread(|it| it.first), spread(|it| it.second)],
            median: quantile(&differences, 0.5),
            interval: median_interval(&differences),
            interval_percent: median_coverage(differences.len()).map(|part| 100.0 * part),
            smaller,
            larger,
            p: sign_test(smaller, larger),
        }
    }
}

/// Which flights of pairs landed.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Landed {
    /// Both.
    pub both: usize,
    /// That of the first run alone.
    pub first_alone: usize,
    /// That of the second run alone.
    pub second_alone: usize,
    /// Neither.
    pub neither: usize,
    /// Two-sided sign test of the seeds in which one run landed alone more often than the other.
    pub p: f64,
}

/// In how many seeds the second run has fewer and more flights that landed, landed within 0.1 m or were unsafe.
#[derive(Copy, Clone, Debug, PartialEq, Serialize)]
pub struct Tested {
    /// Number of seeds.
    pub seeds: usize,
    /// Seeds in which the second run has fewer.
    pub fewer: usize,
    /// Seeds in which it has more.
    pub more: usize,
    /// Two-sided sign test of these.
    pub p: f64,
}

impl Tested {
    fn new(pairs: &[Pair<'_>], is: fn(&Flight) -> bool) -> Self {
        let mut ahead: BTreeMap<u64, i64> = BTreeMap::new();
        for it in pairs {
            *ahead.entry(it.first.seed).or_default() +=
                i64::from(is(it.second)) - i64::from(is(it.first));
        }
        let seeds = |sign: i64| ahead.values().filter(|by| by.signum() == sign).count();
        let (fewer, more) = (seeds(-1), seeds(1));
        Self { seeds: ahead.len(), fewer, more, p: sign_test(fewer, more) }
    }
}

/// The criteria by which flights are counted: the name in the JSON, and the condition.
pub const COUNTS: [Counted; 3] = [
    ("landed", Flight::is_landed),
    ("within_100_mm", |it| it.is_within(0.1)),
    ("unsafe", Flight::is_unsafe),
];
type Counted = (&'static str, fn(&Flight) -> bool);

/// Pairs of some circumstances, or of all; for tests and intervals a seed counts once.
#[derive(Clone, Debug, Serialize)]
pub struct Pairs {
    /// Number of pairs.
    pub pairs: usize,
    /// The tests of the counts, by their names.
    pub counts: BTreeMap<&'static str, Tested>,
    /// Which of them landed.
    pub landed: Landed,
    /// The differences of those of which both landed, by the measure's name.
    pub differences: BTreeMap<&'static str, Difference>,
}

impl Pairs {
    fn new(pairs: &[Pair<'_>]) -> Self {
        let count = |first: bool, second: bool| {
            let is =
                |it: &&Pair<'_>| (it.first.is_landed(), it.second.is_landed()) == (first, second);
            pairs.iter().filter(is).count()
        };
        let (first_alone, second_alone) = (count(true, false), count(false, true));
        let counts = COUNTS.map(|(name, is)| (name, Tested::new(pairs, is)));
        Self {
            pairs: pairs.len(),
            landed: Landed {
                both: count(true, true),
                first_alone,
                second_alone,
                neither: count(false, false),
                p: Tested::new(pairs, Flight::is_landed).p,
            },
            counts: counts.into_iter().collect(),
            differences: MEASURES
                .iter()
                .map(|measure| (measure.name, Difference::new(&values(measure, pairs))))
                .collect(),
        }
    }
}

/// The values of a measure in pairs of which both landed.
fn values(measure: &Measure, pairs: &[Pair<'_>]) -> Vec<Point> {
    let both = |it: &Pair<'_>| {
        let (first, second) = (measure.of_landed(it.first)?, measure.of_landed(it.second)?);
        Some(Point { seed: it.first.seed, first, second })
    };
    pairs.iter().filter_map(both).collect()
}

/// The pairs of some circumstances, with the results of each run in them.
#[derive(Clone, Debug, Serialize)]
pub struct Cell {
    /// The name of the circumstances.
    pub cell: String,
    /// The results of the paired flights of each run.
    pub runs: [Summary; 2],
    /// The pairs.
    #[serde(flatten)]
    pub pairs: Pairs,
}

/// Two runs, side by side.
#[derive(Clone, Debug, Serialize)]
pub struct Comparison {
    /// Warnings on the validity of all numbers.
    pub warnings: Vec<String>,
    /// The first and the second run, with all of their flights.
    pub runs: [Side; 2],
    /// The results of the paired flights of each run.
    pub paired: [Summary; 2],
    /// All pairs.
    #[serde(flatten)]
    pub pairs: Pairs,
    /// The pairs of each circumstances.
    pub cells: Vec<Cell>,
    /// The values of the pairs, for the plot, by measure.
    #[serde(skip)]
    pub points: BTreeMap<&'static str, Vec<Point>>,
}

impl Comparison {
    /// Compares two runs.
    ///
    /// # Errors
    /// When no flight of one has the circumstances and the seed of one of the other.
    pub fn new(first: &Run, second: &Run) -> anyhow::Result<Self> {
        let key = |flight: &Flight| (flight.cell.clone(), flight.seed);
        let of_second: BTreeMap<_, &Flight> =
            second.flights.iter().map(|flight| (key(flight), flight)).collect();
        let pairs: Vec<Pair<'_>> = first
            .flights
            .iter()
            .filter_map(|flight| Some(Pair { first: flight, second: of_second.get(&key(flight))? }))
            .collect();
        let example = |run: &Run| {
            let flight = run.flights.first();
            flight.map_or_else(String::new, |it| format!("seed {} of {}", it.seed, it.cell))
        };
        ensure!(
            !pairs.is_empty(),
            "no flight of one has the circumstances and the seed of one of the other, so they cannot be compared: {} has {}, {} has {}",
            first.folder.display(),
            example(first),
            second.folder.display(),
            example(second),
        );
        let mut cells: Vec<(&str, Vec<Pair<'_>>)> = Vec::new();
        for pair in &pairs {
            match cells.iter_mut().find(|(name, _)| *name == pair.first.cell) {
                Some((_, members)) => members.push(*pair),
                None => cells.push((&pair.first.cell, vec![*pair])),
            }
        }
        let cells = cells.into_iter().map(|(name, members)| Cell {
            cell: name.to_owned(),
            runs: summaries(&members),
            pairs: Pairs::new(&members),
        });
        let needs_warning = |run: &Run| {
            run.flights.iter().any(|flight| only_size_counts(&flight.vision, &flight.settings))
        };
        let warning =
            [first, second].into_iter().any(needs_warning).then(|| ONLY_SIZE_COUNTS.to_owned());
        Ok(Self {
            warnings: warning.into_iter().collect(),
            runs: [side(first, pairs.len()), side(second, pairs.len())],
            cells: cells.collect(),
            paired: summaries(&pairs),
            points: MEASURES.iter().map(|it| (it.name, values(it, &pairs))).collect(),
            pairs: Pairs::new(&pairs),
        })
    }
}

/// The results of the flights of each run in these pairs.
fn summaries(pairs: &[Pair<'_>]) -> [Summary; 2] {
    let (first, second): (Vec<&Flight>, Vec<&Flight>) =
        pairs.iter().map(|pair| (pair.first, pair.second)).unzip();
    [Summary::new(&first), Summary::new(&second)]
}

fn side(run: &Run, pairs: usize) -> Side {
    let different = |of: fn(&Flight) -> &String| {
        let texts: BTreeSet<&String> = run.flights.iter().map(of).collect();
        texts.into_iter().cloned().collect()
    };
    Side {
        folder: run.folder.clone(),
        settings: different(|it| &it.settings),
        programs: different(|it| &it.program),
        visions: different(|it| &it.vision),
        unpaired: run.flights.len().saturating_sub(pairs),
        summary: Summary::new(&run.flights.iter().collect::<Vec<_>>()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn flight(cell: &str, seed: u64, error_m: Option<f64>) -> Flight {
        Flight {
            cell: cell.to_owned(),
            seed,
            vision: "modelled".to_owned(),
            settings: "controller.guidance=metric".to_owned(),
            program: "0.1.0".to_owned(),
            ending: if error_m.is_some() { Ending::Landed } else { Ending::Aborted },
            touchdown_error_m: error_m,
            touchdown_speed_m_s: error_m.map(|_| 0.5),
            touchdown_lateral_speed_m_s: error_m.map(|_| 0.1),
            time_to_disarm_s: error_m.map(|_| 12.0),
        }
    }

    fn run(flights: Vec<Flight>) -> Run {
        Run { folder: PathBuf::from("run"), flights }
    }

    #[test]
    fn flights_of_the_same_circumstances_and_seed_are_compared_and_no_others() {
        let errors_m = [0.01, 0.02, 0.03, 0.04, 0.05, 0.06, 0.07];
        let first = (1..).zip(errors_m).map(|(seed, error_m)| flight("calm", seed, Some(error_m)));
        // The pairs differ by 0.02 m each, in any order of the rows, and one more has not landed.
        let mut second: Vec<Flight> = (1..)
            .zip(errors_m)
            .map(|(seed, error_m)| flight("calm", seed, Some(error_m + 0.02)))
            .collect();
        second.reverse();
        second.push(flight("calm", 8, None));
        second.push(flight("windy", 1, Some(0.5)));
        let first = run(first.chain([flight("calm", 8, Some(0.01))]).collect());
        let comparison = Comparison::new(&first, &run(second)).unwrap();
        let [a, b] = &comparison.runs;
        assert_eq!((a.unpaired, b.unpaired, comparison.pairs.pairs), (0, 1, 8));
        assert_eq!((a.summary.landed, b.summary.landed, b.summary.dangerous), (8, 8, 1));
        let landed = &comparison.pairs.landed;
        assert_eq!((landed.both, landed.first_alone, landed.second_alone), (7, 1, 0));
        let error = &comparison.pairs.differences["touchdown_error_m"];
        assert_eq!((error.pairs, error.smaller, error.larger), (7, 0, 7));
        let [low, high] = error.interval.unwrap();
        for value in [error.median.unwrap(), low, high] {
            assert!((value - 0.02).abs() < 1e-9, "{value}");
        }
        assert!((error.p - 2.0 / 128.0).abs() < 1e-9, "{}", error.p);
        let same = &comparison.pairs.differences["time_to_disarm_s"];
        assert_eq!((same.smaller, same.larger, same.p), (0, 0, 1.0));
        assert_eq!(comparison.cells.len(), 1);
    }

    #[test]
    fn a_seed_counts_once_however_many_circumstances_it_is_flown_in() {
        let cells = ["calm", "windy", "late"];
        // Seed 7 does not land in the second run.
        let flown = |errors_m: [f64; 3], of_last: [Option<f64>; 3]| {
            let of_seed = |seed: u64| {
                let errors_m = if seed == 7 { of_last } else { errors_m.map(Some) };
                cells.into_iter().zip(errors_m).map(move |(cell, error)| flight(cell, seed, error))
            };
            run((1..=7).flat_map(of_seed).collect())
        };
        let first = flown([0.05, 0.05, 0.05], [Some(0.05); 3]);
        let second = flown([0.04, 0.02, 0.09], [None; 3]);
        let comparison = Comparison::new(&first, &second).unwrap();
        let landed = &comparison.pairs.landed;
        assert_eq!((landed.both, landed.first_alone, landed.second_alone), (18, 3, 0));
        assert!((landed.p - 1.0).abs() < 1e-9, "{}", landed.p);
        let error = &comparison.pairs.differences["touchdown_error_m"];
        assert_eq!((error.pairs, error.seeds, error.smaller, error.larger), (18, 6, 6, 0));
        // Not that of 12 and 6 pairs.
        assert!((error.p - 2.0 / 64.0).abs() < 1e-9, "{}", error.p);
        for value in [error.median.unwrap(), error.interval.unwrap()[0]] {
            assert!((value + 0.01).abs() < 1e-9, "{value}");
        }
        // Those of every seed but 7 are within 0.1 m in both.
        let within = comparison.pairs.counts["within_100_mm"];
        assert_eq!((within.seeds, within.fewer, within.more), (7, 1, 0));
        let late = &comparison.cells[2].pairs.differences["touchdown_error_m"];
        assert_eq!((late.pairs, late.seeds, late.smaller, late.larger), (6, 6, 0, 6));
    }

    #[test]
    fn both_sides_of_a_comparison_have_the_same_pairs() {
        // The second run's flights without a partner that landed have large errors.
        let first = [Some(0.01), Some(0.03), None];
        let second = [Some(0.02), Some(0.04), Some(0.9)];
        let of = |errors_m: [Option<f64>; 3]| {
            run((1..).zip(errors_m).map(|(seed, error_m)| flight("calm", seed, error_m)).collect())
        };
        let comparison = Comparison::new(&of(first), &of(second)).unwrap();
        let worst = |spread: Option<Spread>| spread.unwrap().worst;
        let error = &comparison.pairs.differences["touchdown_error_m"];
        assert_eq!(error.runs.map(worst), [0.03, 0.04]);
        let of_all = comparison.runs.each_ref().map(|it| it.summary.measures["touchdown_error_m"]);
        assert_eq!(of_all.map(worst), [0.03, 0.9]);
    }

    #[test]
    fn runs_without_a_pair_are_refused_with_their_contents() {
        let [one, other] = [1, 2].map(|seed| run(vec![flight("calm", seed, None)]));
        let error = Comparison::new(&one, &other).unwrap_err().to_string();
        assert!(error.contains("seed 1 of calm") && error.contains("seed 2 of calm"), "{error}");
    }

    #[test]
    fn a_file_that_is_no_run_of_landings_is_refused_by_its_line() {
        let folder = tempfile::tempdir().unwrap();
        let error_of = |folder: &Path| format!("{:#}", Run::read(folder).unwrap_err());
        assert!(error_of(folder.path()).contains("alight experiment landing"));
        std::fs::write(folder.path().join(FLIGHTS_AS_JSON), "{\"seed\":1}\n").unwrap();
        assert!(error_of(folder.path()).contains("line 1 of"));
        std::fs::write(folder.path().join(FLIGHTS_AS_JSON), "").unwrap();
        assert!(error_of(folder.path()).contains("no flight"));
    }
}
