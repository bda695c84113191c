//! Lists the keys of the controller's configuration that are parameters at the ground station, with their names.

/// A parameter: its name in MAVLink and its key.
#[derive(Debug, PartialEq)]
pub(crate) struct Parameter {
    /// At most 16 characters, as MAVLink has no more.
    pub(crate) name: &'static str,
    /// Key of the controller's configuration, with its unit in the name.
    pub(crate) key: &'static str,
    /// The possible words of the key, each with its index as its number; none for a number, and for yes or no.
    pub(crate) words: &'static [&'static str],
}

impl Parameter {
    /// Its unit, by the name of its key; nothing for a word and for a number without a unit.
    pub(crate) fn unit(&self) -> &'static str {
        const UNITS: [(&str, &str); 4] = [("_m_s", "m/s"), ("_hz", "Hz"), ("_m", "m"), ("_s", "s")];
        let of_key = UNITS.iter().find(|(ending, _)| self.key.ends_with(ending));
        of_key.map_or("", |(_, unit)| unit)
    }
}

const PLACES: &[&str] = &["any", "onboard", "ground"];
const STARTS: &[&str] = &["command", "airborne", "takeoff", "resume"];
const MODES: &[&str] = &["guided", "landing-target"];
const GUIDANCES: &[&str] = &["metric", "thesis"];
const ON_ABORT: &[&str] = &["hover", "land", "climb"];
const REACTIONS: &[&str] = &["ignore", "hold", "abort", "land"];

/// All parameters. Their order is that of their indices, so that a ground station may keep a list.
pub(crate) const TABLE: &[Parameter] = &[
    word("AL_DET_PLACE", "detectors.place", PLACES),
    number("AL_DET_AGE", "detectors.max_age_s"),
    number("AL_DET_RATE", "detectors.min_rate_hz"),
    number("AL_DET_RETURN", "detectors.return_after_s"),
    number("AL_DET_TOL", "detectors.tolerance_m"),
    word("AL_START", "start", STARTS),
    number("AL_TKOFF_HGT", "takeoff_height_m"),
    word("AL_MODE", "mode", MODES),
    word("AL_GUIDANCE", "guidance", GUIDANCES),
    number("AL_SP_RATE", "autopilot.setpoint_rate_hz"),
    number("AL_SP_TIMEOUT", "autopilot.setpoint_timeout_s"),
    number("AL_BAT_LOW", "alarms.battery_low"),
    number("AL_BAT_CRIT", "alarms.battery_critical"),
    word("AL_ON_BAT_LOW", "phases.on_battery_low", REACTIONS),
    word("AL_ON_BAT_CRIT", "phases.on_battery_critical", REACTIONS),
    word("AL_ON_OPER_LOST", "phases.on_operator_lost", REACTIONS),
    word("AL_ON_LINK_LOST", "phases.on_autopilot_lost", REACTIONS),
    word("AL_ON_ABORT", "phases.on_abort", ON_ABORT),
    number("AL_MAX_HORIZ", "envelope.horizontal_m_s"),
    number("AL_MAX_CLIMB", "envelope.climb_m_s"),
    number("AL_MAX_DESCEND", "envelope.descend_m_s"),
    number("AL_LOST_TIME", "phases.lost_target_s"),
    number("AL_SRCH_HGT", "phases.search_height_m"),
    number("AL_SRCH_SPEED", "phases.search_speed_m_s"),
    number("AL_SRCH_RADIUS", "phases.search_radius_m"),
    number("AL_FENCE_RADIUS", "phases.fence_radius_m"),
    number("AL_FENCE_HGT", "phases.fence_height_m"),
    number("AL_RETRIES", "phases.retries"),
    number("AL_LAND_TIMEOUT", "phases.landing_timeout_s"),
    number("AL_DESC_SPEED", "metric.max_descend_m_s"),
    number("AL_TOUCH_SPEED", "metric.touchdown_descend_m_s"),
    number("AL_FUNNEL", "metric.funnel_m"),
    number("AL_LAND_HGT", "metric.land_height_m"),
    number("AL_STAND_HGT", "metric.standing_height_m"),
    number("AL_BLIND_HGT", "metric.blind_height_m"),
    number("AL_BLIND_TIME", "metric.blind_s"),
];

const fn number(name: &'static str, key: &'static str) -> Parameter {
    Parameter { name, key, words: &[] }
}

const fn word(name: &'static str, key: &'static str, words: &'static [&'static str]) -> Parameter {
    Parameter { name, key, words }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Cells of a row of the document's table: name, unit or words, key, meaning.
    fn row(line: &str) -> Option<[&str; 4]> {
        let cells: Vec<&str> = line.strip_prefix("| `AL_")?.split('|').map(str::trim).collect();
        cells.get(..4)?.try_into().ok()
    }

    #[test]
    fn the_document_lists_all_parameters_in_their_order_with_units_words_and_meanings() {
        let document = include_str!("../../docs/parameters.md");
        let rows: Vec<[&str; 4]> = document.lines().filter_map(row).collect();
        let names: Vec<String> =
            rows.iter().map(|[name, ..]| format!("AL_{}", name.trim_end_matches('`'))).collect();
        assert_eq!(names, TABLE.iter().map(|it| it.name).collect::<Vec<_>>());
        for (parameter, [_, unit, key, meaning]) in TABLE.iter().zip(rows) {
            let words = parameter.words.iter().enumerate();
            let words: Vec<String> =
                words.map(|(number, word)| format!("{number} {word}")).collect();
            let expected =
                if words.is_empty() { parameter.unit().into() } else { words.join(", ") };
            assert_eq!(unit, expected, "{}", parameter.name);
            assert_eq!(key, format!("`{}`", parameter.key));
            assert!(!meaning.is_empty(), "{}", parameter.name);
        }
    }
}
