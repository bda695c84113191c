//! Makes the charts of the report, over time or from above: path over the pad, height, velocity against setpoints, frames by
//! fate, light, latency, wind, battery, and the thesis' figures. Those of two flights are the same, one by one, so that
//! their axes can be shared.

use std::collections::BTreeMap;
use std::f64::consts::TAU;

use crate::chart::{At, Axes, Chart, Ink, Layer, Shape, at, layer, span};
use crate::flight::Light;
use crate::frames::Fate;
use crate::latency::between_ms;
use crate::track::TrackPoint;
use crate::view::{View, component, pieces, unbridged};

/// Height of a chart over time, as shown, in pixels.
const HEIGHT: u32 = 270;
/// Times beyond this are of no flight, in seconds.
const MAX_SECOND: f64 = 1e6;
/// Number of ellipses of uncertainty in the view from above.
const CIRCLES: usize = 14;
/// Largest radius of one that is drawn, relative to the extent of the picture without them.
const MAX_CIRCLE: f64 = 0.5;
/// Names of the axes of local NED.
const NED: [&str; 3] = ["north", "east", "down"];
/// The standard deviations that are drawn.
const SIGMAS: f64 = 2.0;

/// A chart over time.
fn over_time(view: &View<'_>, title: &str, unit: &str, layers: Vec<Layer>) -> Chart {
    let values = layers.iter().flat_map(|layer| &layer.points).map(|point| point.y);
    let y = span(values, 0.0..1e-3);
    Chart {
        title: title.to_owned(),
        axes: Axes {
            x_name: match view.summary.has_landing {
                true => "time since the landing began, s".to_owned(),
                false => "time since the recording began, s".to_owned(),
            },
            y_name: unit.to_owned(),
            x: view.time.clone(),
            y,
            is_equal: false,
        },
        bands: view.bands(),
        layers,
        rows: Vec::new(),
        height: HEIGHT,
        note: String::new(),
    }
}

/// The landing in one picture: from above, and from the side.
pub fn landing(view: &View<'_>) -> Vec<Chart> {
    // From the begin of the landing on: the flight before it is not shown.
    let landing = |positions: &[TrackPoint]| -> Vec<TrackPoint> {
        let shown = positions.iter().filter(|it| it.time_s >= 0.0 && view.is_shown(it.time_s));
        shown.copied().collect()
    };
    let (truth, estimated) = (landing(&view.truth), landing(&view.estimated));
    let positions = || truth.iter().chain(&estimated);
    let away = |it: &TrackPoint| at(it.east_m, it.north_m);
    let mut above = Vec::new();
    let extent = span(positions().flat_map(|it| [it.east_m, it.north_m]), -0.3..0.3);
    let step = estimated.len().div_ceil(CIRCLES).max(1);
    // A circle is drawn completely or not at all: those of moderate size make the picture larger, the others would make the rest small.
    let max_radius_m = MAX_CIRCLE * (extent.end - extent.start);
    // An estimate without a deviation, as the thesis' guidance has none, is not a sure one.
    let with_deviation = || estimated.iter().filter(|it| it.deviation_m > 0.0);
    let (drawn, left_out): (Vec<&TrackPoint>, Vec<&TrackPoint>) =
        with_deviation().step_by(step).partition(|it| SIGMAS * it.deviation_m <= max_radius_m);
    let circles: Vec<At> = drawn.into_iter().flat_map(circle).collect();
    let around = circles.iter().flat_map(|it| [it.x, it.y]).filter(|it| it.is_finite());
    let extent = span(around, extent);
    above.push(layer("circles: 2 standard deviations", Ink::Blue, Shape::Thin, circles));
    let from_above = |positions: &[TrackPoint]| unbridged(positions, |it| it.time_s, away);
    above.push(layer("truth", Ink::Orange, Shape::Wide, from_above(&truth)));
    above.push(layer("estimate", Ink::Blue, Shape::Line, from_above(&estimated)));
    above.push(layer("pad", Ink::Text, Shape::Crosses, [at(0.0, 0.0)]));
    let start = truth.first().or(estimated.first());
    // Last and large: the vehicle's path begins there, and would cover it.
    above.push(layer("start", Ink::Green, Shape::LargeDots, start.map(away)));

    // Seen across the way from the start to the pad.
    let (toward_north, toward_east) = match start {
        Some(it) if it.north_m.hypot(it.east_m) > 0.05 => {
            let away_m = it.north_m.hypot(it.east_m);
            (-it.north_m / away_m, -it.east_m / away_m)
        }
        _ => (1.0, 0.0),
    };
    let along = |it: &TrackPoint| it.north_m * toward_north + it.east_m * toward_east;
    let side = |it: &TrackPoint| at(along(it), it.height_m);
    let from_the_side = |positions: &[TrackPoint]| unbridged(positions, |it| it.time_s, side);
    let x = span(positions().map(along), -0.3..0.3);
    let edge = |it: &TrackPoint, sign: f64| {
        let x_m = along(it) + sign * SIGMAS * it.deviation_m;
        at(x_m.clamp(x.start, x.end), it.height_m)
    };
    let with_deviation: Vec<&TrackPoint> = with_deviation().collect();
    // Each piece is an area of its own.
    let around = pieces(&with_deviation, |it| it.time_s).into_iter().flat_map(|piece| {
        let left = piece.iter().map(|it| edge(it, -1.0));
        let right = piece.iter().rev().map(|it| edge(it, 1.0));
        left.chain(right).chain([at(f64::NAN, f64::NAN)])
    });
    let areas: Vec<At> = around.collect();
    let layers = vec![
        layer("2 standard deviations", Ink::Blue, Shape::Area, areas),
        layer("truth", Ink::Orange, Shape::Wide, from_the_side(&truth)),
        layer("estimate", Ink::Blue, Shape::Line, from_the_side(&estimated)),
        layer("pad", Ink::Text, Shape::Crosses, [at(0.0, 0.0)]),
    ];
    let from_above = Chart {
        title: "From above, relative to the pad".to_owned(),
        axes: Axes {
            x_name: "east, m".to_owned(),
            y_name: "north, m".to_owned(),
            x: extent.clone(),
            y: extent,
            is_equal: true,
        },
        bands: Vec::new(),
        layers: above,
        rows: Vec::new(),
        height: 430,
        note: match left_out.len() {
            0 => String::new(),
            1 => "a larger circle is left out".to_owned(),
            count => format!("{count} larger circles are left out"),
        },
    };
    let from_the_side = Chart {
        title: "From the side, along the way from the start to the pad".to_owned(),
        axes: Axes {
            x_name: "past the pad, m (the two axes have different scales)".to_owned(),
            y_name: "height over the pad, m".to_owned(),
            x,
            y: span(positions().map(|it| it.height_m), 0.0..1.0),
            is_equal: false,
        },
        layers,
        note: String::new(),
        ..from_above.clone()
    };
    vec![from_above, from_the_side]
}

/// The circle of a position's uncertainty, and a gap after it.
fn circle(point: &TrackPoint) -> Vec<At> {
    let radius_m = SIGMAS * point.deviation_m;
    let around = (0..=24).map(|part| {
        let (sin, cos) = (TAU * f64::from(part) / 24.0).sin_cos();
        at(point.east_m + radius_m * sin, point.north_m + radius_m * cos)
    });
    around.chain([at(f64::NAN, f64::NAN)]).collect()
}

/// Height, distance from the pad, and the error of the estimate.
pub fn height(view: &View<'_>) -> Vec<Chart> {
    let flight = view.flight;
    let target = |of: fn(&messages::TargetEstimate) -> Option<f64>| {
        view.curve(&flight.targets, |it| Some(at(flight.at_s(it.stamp_ns), of(it)?)))
    };
    let truth =
        |of: fn(&TrackPoint) -> f64| view.curve(&view.truth, |it| Some(at(it.time_s, of(it))));
    let distance = |it: &TrackPoint| it.north_m.hypot(it.east_m);
    let height = vec![
        layer("truth", Ink::Orange, Shape::Wide, truth(|it| it.height_m)),
        layer("estimate", Ink::Blue, Shape::Line, target(|it| it.height_m)),
    ];
    let lateral = vec![
        layer("truth", Ink::Orange, Shape::Wide, truth(distance)),
        layer("estimate", Ink::Blue, Shape::Line, target(|it| it.lateral_error_m)),
    ];
    let mut deviation = down_to_zero(&target(|it| it.deviation_m));
    let error = view.curve(&view.errors, |it| Some(at(it.time_s, it.horizontal_m)));
    // The large first deviations of the estimate would flatten the rest.
    let max = span(error.iter().map(|it| it.y), 0.0..0.05).end;
    let max = if error.is_empty() { f64::INFINITY } else { 2.0 * max };
    let is_cut = deviation.iter().any(|point| point.y > max);
    // A point that is not a number stays one: it is a gap.
    for point in deviation.iter_mut().filter(|point| point.y > max) {
        point.y = max;
    }
    let errors = vec![
        layer("claimed standard deviation", Ink::Blue, Shape::Area, deviation),
        layer("error of the estimate against truth", Ink::Red, Shape::Line, error),
    ];
    let mut charts = vec![
        over_time(view, "Height over the pad", "m", height),
        over_time(view, "Horizontal distance from the pad", "m", lateral),
        over_time(view, "Horizontal error of the estimate", "m", errors),
    ];
    if let Some(chart) = charts.last_mut() {
        if view.errors.is_empty() {
            chart.note = "truth was not recorded".to_owned();
        } else if is_cut {
            chart.note = format!("the claim is cut at {max:.2} m");
        }
    }
    charts
}

/// The areas between a curve and zero, one for each piece of it.
fn down_to_zero(curve: &[At]) -> Vec<At> {
    let mut areas = Vec::with_capacity(curve.len());
    for piece in curve.split(|it| !it.y.is_finite()) {
        let (Some(first), Some(last)) = (piece.first(), piece.last()) else { continue };
        areas.push(at(first.x, 0.0));
        areas.extend_from_slice(piece);
        areas.extend([at(last.x, 0.0), at(last.x, f64::NAN)]);
    }
    areas
}

/// Setpoints against the vehicle's response.
pub fn velocity(view: &View<'_>) -> Vec<Chart> {
    let flight = view.flight;
    let axis = |axis: usize, name: &str| {
        let response = view.curve(&flight.vehicle, |it| {
            Some(at(flight.at_s(it.stamp_ns), component(it.velocity_ned_m_s, axis)))
        });
        let layers = vec![
            layer("vehicle", Ink::Orange, Shape::Line, response),
            layer("setpoint", Ink::Blue, Shape::Steps, view.setpoint_curve(axis)),
        ];
        over_time(view, &format!("Velocity to the {name}"), "m/s", layers)
    };
    let mut charts: Vec<Chart> =
        NED.iter().enumerate().take(2).map(|(index, name)| axis(index, name)).collect();
    let mut down = axis(2, "down");
    down.title = "Velocity downwards".to_owned();
    charts.push(down);
    let tilt = view.curve(&flight.vehicle, |it| {
        Some(at(flight.at_s(it.stamp_ns), crate::summary::tilt_deg(it.ned_from_body_wxyz)))
    });
    charts.push(over_time(
        view,
        "Tilt",
        "deg",
        vec![layer("vehicle", Ink::Orange, Shape::Line, tilt)],
    ));
    charts
}

/// The outcome of each frame over time.
pub fn detections(view: &View<'_>) -> Vec<Chart> {
    let fates: Vec<Fate> = view.frames.fates().into_iter().rev().collect();
    let mut layers = Vec::new();
    for (row, fate) in fates.iter().enumerate() {
        let ink = match fate {
            Fate::Used => Ink::Green,
            Fate::Refused(_) => Ink::Red,
            Fate::NoMarker => Ink::Orange,
            Fate::Standby | Fate::NotNeeded | Fate::OnGround | Fate::NotTaken | Fate::Unknown => {
                Ink::Grey
            }
        };
        let frames = view.frames.all.iter().filter(|it| it.fate == *fate);
        let points = frames.map(|it| at(view.flight.at_s(it.exposed_ns), row as f64));
        let points = points.filter(|it| view.is_shown(it.x));
        layers.push(layer("", ink, Shape::Dots, points));
    }
    let mut chart = over_time(view, "Outcome of each frame", "", layers);
    chart.axes.y = -0.6..fates.len().max(1) as f64 - 0.1;
    chart.rows = fates.iter().map(|fate| fate.name().to_owned()).collect();
    chart.height = 150 + 26 * fates.len() as u32;
    // Estimates without a new detection repeat that of the last one.
    let targets = &view.flight.targets;
    let before = std::iter::once(None).chain(targets.iter().map(|it| it.nis));
    let with_new = targets.iter().zip(before).filter(|(it, before)| it.nis != *before);
    let with_new: Vec<_> = with_new.map(|(it, _)| it).collect();
    let nis =
        view.curve(&with_new, |it| Some(at(view.flight.at_s(it.stamp_ns), it.nis?.min(30.0))));
    let mut consistency = over_time(
        view,
        "Surprise of each detection (normalised innovation squared)",
        "",
        vec![layer(
            "mean 3: errors as large as stated, less: smaller; cut at 30",
            Ink::Blue,
            Shape::Dots,
            nis,
        )],
    );
    consistency.height = HEIGHT;
    vec![chart, consistency, light(view)]
}

/// How bright the pictures were: of the camera with the most of them.
fn light(view: &View<'_>) -> Chart {
    let pictures = view.flight.light.values().max_by_key(|it| it.len());
    let pictures = pictures.map_or(&[][..], Vec::as_slice);
    let curve = |of: fn(&Light) -> f64| {
        view.curve(pictures, |it| Some(at(view.flight.at_s(it.stamp_ns), 100.0 * of(it))))
    };
    let brightest = curve(|it| it.brightness.brightest);
    let mean = curve(|it| it.brightness.mean);
    let noise = curve(|it| it.brightness.noise);
    let mut chart = over_time(
        view,
        "Brightness and noise of the pictures",
        "% of white",
        vec![
            layer("brightest hundredth of the pixels", Ink::Orange, Shape::Line, brightest),
            layer("mean", Ink::Blue, Shape::Line, mean),
            layer("noise", Ink::Red, Shape::Line, noise),
        ],
    );
    chart.axes.y = 0.0..100.0;
    chart
}

/// How long frames took.
pub fn latency(view: &View<'_>) -> Vec<Chart> {
    let flight = view.flight;
    let in_use = || view.frames.all.iter().filter(|it| it.fate != Fate::Standby);
    let point = |exposed_ns: i64, to_ns: i64| {
        let point = at(flight.at_s(exposed_ns), between_ms(exposed_ns, to_ns));
        (view.is_shown(point.x) && (0.0..60_000.0).contains(&point.y)).then_some(point)
    };
    let setpoints = in_use().filter_map(|it| point(it.exposed_ns, it.setpoint_ns?));
    let detected = in_use().filter_map(|it| point(it.exposed_ns, it.handled_ns));
    let layers = vec![
        layer("exposure to setpoint", Ink::Orange, Shape::LargeDots, setpoints),
        layer("exposure to detections at the controller", Ink::Blue, Shape::Dots, detected),
    ];
    let mut chart = over_time(view, "Age of used detections", "ms", layers);
    // A single frame, as the first after a start, would flatten the rest: it stands at the upper edge.
    let ages: Vec<f64> =
        chart.layers.iter().flat_map(|it| &it.points).map(|point| point.y).collect();
    let high = 2.5 * node::stats::quantile(&ages, 0.95).unwrap_or(0.0).max(10.0);
    let oldest = ages.iter().copied().fold(0.0, f64::max);
    if oldest > high {
        chart.axes.y.end = high;
        let mut beyond = Vec::new();
        for layer in &mut chart.layers {
            beyond.extend(layer.points.iter().filter(|it| it.y > high).map(|it| at(it.x, high)));
            layer.points.retain(|point| point.y <= high);
        }
        let count = beyond.len();
        let name = format!("older: {count} beyond {high:.0} ms, up to {oldest:.0} ms");
        chart.layers.push(layer(&name, Ink::Red, Shape::Crosses, beyond));
    }
    vec![chart]
}

/// True and estimated wind, named by the direction from which it blows.
pub fn wind(view: &View<'_>) -> Vec<Chart> {
    let flight = view.flight;
    let axis = |axis: usize, from: &str, against: &str| {
        let truth = view.curve(&flight.wind, |it| {
            Some(at(flight.at_s(it.stamp_ns), -component(it.velocity_ned_m_s, axis)))
        });
        let estimate = view.curve(&flight.targets, |it| {
            Some(at(flight.at_s(it.stamp_ns), -*it.wind_ned_m_s?.get(axis)?))
        });
        let layers = vec![
            layer("truth", Ink::Orange, Shape::Line, truth),
            layer("estimate from the tilt", Ink::Blue, Shape::Line, estimate),
        ];
        over_time(
            view,
            &format!("Wind from the {from} (negative: from the {against})"),
            "m/s",
            layers,
        )
    };
    vec![axis(0, "north", "south"), axis(1, "east", "west")]
}

/// Battery and link.
pub fn battery(view: &View<'_>) -> Vec<Chart> {
    let flight = view.flight;
    let charge = view.curve(&flight.vehicle, |it| {
        Some(at(flight.at_s(it.stamp_ns), 100.0 * f64::from(it.battery?)))
    });
    let voltage = view.curve(&flight.packets.power, |it| {
        Some(at(flight.at_s(flight.vehicle_ns(it.received_ns)), it.voltage_v?))
    });
    let received = flight.packets.received.iter();
    let mut packets = per_second(received.map(|it| flight.at_s(flight.vehicle_ns(it.received_ns))));
    packets.retain(|point| view.is_shown(point.x));
    let line = |name: &str, ink, points| vec![layer(name, ink, Shape::Line, points)];
    let mut voltage =
        over_time(view, "Battery, voltage", "V", line("voltage", Ink::Purple, voltage));
    let volts = voltage.layers.iter().flat_map(|it| &it.points).map(|it| it.y);
    let low = volts.fold(f64::INFINITY, f64::min);
    if low.is_finite() {
        voltage.axes.y.start = (low - 0.5).max(0.0);
    }
    vec![
        over_time(view, "Battery, charge", "%", line("charge", Ink::Green, charge)),
        voltage,
        over_time(
            view,
            "Packets of the autopilot",
            "1/s",
            line("packets a second", Ink::Blue, packets),
        ),
    ]
}

/// How many times there are in each second, from that of the first to that of the last: none in a second is 0.
fn per_second(times_s: impl Iterator<Item = f64>) -> Vec<At> {
    let mut counts = BTreeMap::new();
    for second in times_s.filter(|it| it.abs() < MAX_SECOND).map(|it| it.floor() as i64) {
        *counts.entry(second).or_insert(0_u32) += 1;
    }
    let (Some(first), Some(last)) = (counts.keys().next(), counts.keys().next_back()) else {
        return Vec::new();
    };
    let count = |second| counts.get(&second).copied().map_or(0.0, f64::from);
    (*first..=*last).map(|second| at(second as f64 + 0.5, count(second))).collect()
}

/// Figures 4.10 to 4.16 of the thesis.
pub fn thesis(view: &View<'_>) -> Vec<Chart> {
    let flight = view.flight;
    let from_truth = !flight.truth.is_empty();
    let vehicle = |of: &dyn Fn([f64; 3]) -> f64| -> Vec<At> {
        match from_truth {
            true => view.curve(&flight.truth, |it| {
                Some(at(flight.at_s(it.stamp_ns), of(it.position_ned_m)))
            }),
            false => view.curve(&flight.vehicle, |it| {
                Some(at(flight.at_s(it.stamp_ns), of(it.position_ned_m)))
            }),
        }
    };
    let pad = |of: &dyn Fn([f64; 3]) -> f64| -> Vec<At> {
        match from_truth {
            true => {
                view.curve(&flight.truth, |it| Some(at(flight.at_s(it.stamp_ns), of(it.pad_ned_m))))
            }
            false => view.curve(&flight.targets, |it| {
                Some(at(flight.at_s(it.stamp_ns), of(it.position_ned_m?)))
            }),
        }
    };
    let mut charts = trajectories(&vehicle, &pad);
    for (axis, name) in ["x (north)", "y (east)", "z (down)"].into_iter().enumerate() {
        let of = |vector: [f64; 3]| component(vector, axis);
        let layers = vec![
            layer("position, m", Ink::Orange, Shape::Line, vehicle(&of)),
            layer("pad, m", Ink::Green, Shape::Thin, pad(&of)),
            layer("command velocity, m/s", Ink::Blue, Shape::Steps, view.setpoint_curve(axis)),
        ];
        let number = 11 + axis;
        let title = format!("Figure 4.{number}: position and command velocity, {name}");
        charts.push(over_time(view, &title, "m, m/s", layers));
    }
    for (axis, name) in ["x (north)", "y (east)", "z (down)"].into_iter().enumerate() {
        let wind = view.curve(&flight.wind, |it| {
            Some(at(flight.at_s(it.stamp_ns), component(it.velocity_ned_m_s, axis)))
        });
        let is_there = !wind.is_empty();
        let layers = vec![
            layer("wind, m/s", Ink::Orange, Shape::Line, wind),
            layer("command velocity, m/s", Ink::Blue, Shape::Steps, view.setpoint_curve(axis)),
        ];
        let number = 14 + axis;
        let title = format!("Figure 4.{number}: wind and command velocity, {name}");
        let mut chart = over_time(view, &title, "m/s", layers);
        if !is_there {
            chart.note = "the wind was not recorded".to_owned();
        }
        charts.push(chart);
    }
    charts
}

type Curve<'a> = &'a dyn Fn(&dyn Fn([f64; 3]) -> f64) -> Vec<At>;

/// Figure 4.10 from above and from the south.
fn trajectories(vehicle: Curve<'_>, pad: Curve<'_>) -> Vec<Chart> {
    let views = [("from above", 1, 0, "north, m"), ("from the south", 1, 2, "height, m")];
    let trajectory = |name: &str, across: usize, up: usize, y_name: &str| {
        let sign = if up == 2 { -1.0 } else { 1.0 };
        let path = |curve: Curve<'_>| -> Vec<At> {
            let (x, y) = (curve(&|p| component(p, across)), curve(&|p| sign * component(p, up)));
            x.iter().zip(&y).map(|(x, y)| at(x.y, y.y)).collect()
        };
        let (own, pads) = (path(vehicle), path(pad));
        let all = || own.iter().chain(&pads);
        let low_x = all().map(|it| it.x).fold(f64::INFINITY, f64::min);
        let low_y = all().map(|it| it.y).fold(f64::INFINITY, f64::min);
        let finite = |value: f64| if value.abs() < 1e6 { value } else { 0.0 };
        let (low_x, low_y) = (finite(low_x), finite(low_y));
        Chart {
            title: format!("Figure 4.10: trajectory, {name}"),
            axes: Axes {
                x_name: "east, m".to_owned(),
                y_name: y_name.to_owned(),
                x: span(all().map(|it| it.x), low_x - 0.1..low_x + 0.5),
                y: span(all().map(|it| it.y), low_y - 0.1..low_y + 0.5),
                is_equal: true,
            },
            bands: Vec::new(),
            layers: vec![
                layer("vehicle", Ink::Orange, Shape::Line, own.iter().copied()),
                layer("pad", Ink::Green, Shape::Crosses, pads.last().copied()),
            ],
            rows: Vec::new(),
            height: 400,
            note: String::new(),
        }
    };
    views.map(|(name, across, up, y_name)| trajectory(name, across, up, y_name)).into()
}

/// Gives charts that stand side by side the same axes.
pub fn share_axes(one: &mut Chart, other: &mut Chart) {
    if one.is_empty() || other.is_empty() {
        return;
    }
    let joined =
        |a: &std::ops::Range<f64>, b: &std::ops::Range<f64>| a.start.min(b.start)..a.end.max(b.end);
    one.axes.x = joined(&one.axes.x, &other.axes.x);
    other.axes.x = one.axes.x.clone();
    // Rows have separate names.
    if one.rows.is_empty() {
        one.axes.y = joined(&one.axes.y, &other.axes.y);
        other.axes.y = one.axes.y.clone();
    }
}
