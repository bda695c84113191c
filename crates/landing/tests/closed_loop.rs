//! Whole landings in a small world.

mod world;

use landing::{Config, Guidance, Phase, ThesisConfig};
use world::{Flight, Scene};

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(f64::NAN)
}

fn summary(flights: &[Flight]) -> String {
    let of = |f: fn(&Flight) -> f64| {
        let values: Vec<f64> = flights.iter().map(f).collect();
        let worst = values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        (median(values), worst)
    };
    let (land, _) = of(|f| f.land_s.unwrap_or(f64::INFINITY));
    let (disarm, slowest) = of(|f| f.disarm_s.unwrap_or(f64::INFINITY));
    let (error, worst) = of(|f| f.error_m);
    let (overshoot, most) = of(|f| f.overshoot_m);
    let (_, tilt) = of(|f| f.max_tilt_rad.to_degrees());
    format!(
        "LAND {land:.1} s, disarmed {disarm:.1} (slowest {slowest:.1}) s, error {error:.3} (worst {worst:.3}) m, \
         overshoot {overshoot:.2} ({most:.2}) m, tilt {tilt:.1} deg"
    )
}

#[test]
fn table() {
    for (name, gust, error) in [("calm", 0.0, 0.0), ("light", 0.03, 0.03), ("windy", 0.06, 0.03)] {
        let flights: Vec<Flight> = (0..20)
            .map(|seed| Scene { gust_m_s: gust, estimator_error: error, ..Scene::new(seed) }.fly())
            .collect();
        println!("metric {name}: {}", summary(&flights));
        for f in &flights {
            if f.phase != Phase::Landed || f.error_m > 0.1 {
                println!("  bad: {} {:?} {:?} err {:.3}", f.phase, f.land_s, f.disarm_s, f.error_m);
                let mut last = None;
                for s in &f.samples {
                    let key = (s.decision.phase, s.decision.why);
                    if last != Some(key) {
                        println!("    {:.2} {} {} h {:.2} v {:.2} lat {:?} age {:?}", s.seconds, key.0, key.1, -s.position.z(), s.velocity.z(), s.decision.target.map(|t| (t.lateral_error_m*1000.0).round()), s.decision.target.map(|t| t.age_s));
                        last = Some(key);
                    }
                }
            }
        }
        let flights: Vec<Flight> = (0..20)
            .map(|seed| {
                let thesis = ThesisConfig { seed, ..ThesisConfig::default() };
                let config = Config { guidance: Guidance::Thesis(thesis), ..Config::default() };
                Scene { config, gust_m_s: gust, estimator_error: error, ..Scene::new(seed) }.fly()
            })
            .collect();
        println!("thesis {name}: {}", summary(&flights));
    }
}
