//! Judges good and bad sets of views: counts how many are refused, and for which reason.
#![expect(clippy::print_stdout, reason = "the table is its purpose")]

use std::collections::BTreeMap;

use calibration::{Lens, Options, Refusal, View, calibrate, calibrate_unjudged};

#[path = "../tests/synthetic/mod.rs"]
mod synthetic;

use synthetic::bad::Bad;
use synthetic::{Taking, lenses, views};

fn main() {
    let number = |at: usize, default: u64| {
        std::env::args().nth(at).and_then(|arg| arg.parse().ok()).unwrap_or(default)
    };
    // With a third argument the evidence of each set is printed.
    let (sets, first_seed, is_long) = (number(1, 3), number(2, 0), number(3, 0) > 0);
    println!("{:12} {:>5} {:>8} {:>6}  reasons", "kind", "sets", "refused", "named");
    let kinds = std::iter::once(None).chain(Bad::ALL.map(Some));
    let only = std::env::args().nth(4);
    let is_wanted =
        |kind: &Option<Bad>| only.as_ref().is_none_or(|only| format!("{kind:?}").contains(only));
    for kind in kinds.filter(is_wanted) {
        let (mut all, mut refused, mut named) = (0, 0, 0);
        let mut reasons = BTreeMap::<String, usize>::new();
        for truth in lenses() {
            // Good sets are many, as few may be refused.
            let sets = if kind.is_none() { 10 * sets } else { sets };
            for seed in first_seed..first_seed + sets {
                let (views, lens) = match kind {
                    None => (views(&truth.camera, &Taking::good(seed), seed), truth.lens),
                    Some(bad) => bad.set(&truth, seed),
                };
                let refusal = calibrate(&views, lens, &Options::default()).err();
                if is_long {
                    show(truth.name, seed, &views, lens);
                }
                all += 1;
                if let Some(refusal) = refusal {
                    refused += 1;
                    named += usize::from(kind.is_some_and(|bad| bad.is_named_by(&refusal)));
                    *reasons.entry(format!("{} {}", truth.name, name(&refusal))).or_default() += 1;
                }
            }
        }
        let kind = kind.map_or("good".into(), |bad| format!("{bad:?}"));
        println!("{kind:12} {all:5} {refused:8} {named:6}  {reasons:?}");
    }
}

fn name(refusal: &Refusal) -> String {
    format!("{refusal:?}").split(' ').next().unwrap_or_default().to_owned()
}

fn show(name: &str, seed: u64, views: &[View], lens: Lens) {
    match calibrate_unjudged(views, lens, &Options::default()) {
        Err(refusal) => println!("{name:12} {seed} {refusal}"),
        Ok(found) => println!(
            "{name:12} {seed} noise {:.3} uncertain {:.3} {:?} {:?}",
            found.noise_px,
            found.worst_uncertainty_px(),
            found.cross_validation,
            found.evidence
        ),
    }
}
