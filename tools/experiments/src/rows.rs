//! Writes rows of flights for programs, as lines of JSON and as comma-separated values: columns in the order of the documentation, and numbers
//! without digits that mean nothing.

use std::fmt;

use serde::Serialize;
use serde::de::{Deserialize, Deserializer, MapAccess, Visitor};
use serde_json::Value;

/// Digits after the point by the end of a name: a tenth of a millimetre, of a millimetre per second, a millisecond, a hundredth of a degree.
const DIGITS: [(&str, i32); 5] = [("_m", 4), ("_m_s", 4), ("_s", 3), ("_ms", 3), ("_deg", 2)];

/// A row, with its columns in the order in which they are declared.
struct Row(Vec<(String, Value)>);

impl<'de> Deserialize<'de> for Row {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_map(InOrder)
    }
}

/// Keeps the order of a map.
struct InOrder;

impl<'de> Visitor<'de> for InOrder {
    type Value = Row;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a row")
    }

    fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Row, A::Error> {
        let mut columns = Vec::new();
        while let Some((name, value)) = map.next_entry::<String, Value>()? {
            columns.push((name, value));
        }
        Ok(Row(columns))
    }
}

impl Row {
    fn of(row: &impl Serialize) -> serde_json::Result<Self> {
        let Self(mut columns) = serde_json::from_str(&serde_json::to_string(row)?)?;
        for (name, value) in &mut columns {
            round(name, value);
        }
        Ok(Self(columns))
    }
}

/// Rounds a number, or those of a list, by the end of its name.
fn round(name: &str, value: &mut Value) {
    let ends = DIGITS.iter().filter(|(end, _)| name.ends_with(end));
    let Some((_, digits)) = ends.max_by_key(|(end, _)| end.len()) else { return };
    match value {
        Value::Array(values) => values.iter_mut().for_each(|value| round(name, value)),
        Value::Number(number) if number.is_f64() => {
            let rounded = number.as_f64().map(|it| rounded(it, *digits));
            *value = rounded.map_or(Value::Null, Value::from);
        }
        _ => {}
    }
}

/// A number with so many digits after the point, and 0 without a sign.
pub(crate) fn rounded(value: f64, digits: i32) -> f64 {
    let tens = 10f64.powi(digits);
    // Adding zero makes 0 of -0.
    (value * tens).round() / tens + 0.0
}

/// The names of a row's columns, in their order.
///
/// # Errors
/// When it cannot be written as JSON.
#[cfg(test)]
pub(crate) fn names(row: &impl Serialize) -> serde_json::Result<Vec<String>> {
    Ok(Row::of(row)?.0.into_iter().map(|(name, _)| name).collect())
}

/// Rows as JSON, one per line.
///
/// # Errors
/// When one cannot be written as JSON.
pub(crate) fn json_lines(rows: &[impl Serialize]) -> serde_json::Result<String> {
    let mut text = String::new();
    for row in rows {
        let mut columns = Vec::new();
        for (name, value) in Row::of(row)?.0 {
            columns.push(format!("{}:{value}", Value::from(name)));
        }
        text.push_str(&format!("{{{}}}\n", columns.join(",")));
    }
    Ok(text)
}

/// Rows as comma-separated values, the first line with their names.
///
/// # Errors
/// When one cannot be written as JSON.
pub(crate) fn csv(rows: &[impl Serialize]) -> serde_json::Result<String> {
    let mut text = String::new();
    for (index, row) in rows.iter().enumerate() {
        let (names, values): (Vec<String>, Vec<Value>) = Row::of(row)?.0.into_iter().unzip();
        if index == 0 {
            text.push_str(&names.join(","));
            text.push('\n');
        }
        text.push_str(&values.iter().map(cell).collect::<Vec<_>>().join(","));
        text.push('\n');
    }
    Ok(text)
}

fn cell(value: &Value) -> String {
    match value {
        Value::Null => String::new(),
        Value::String(text) => format!("\"{}\"", text.replace('"', "\"\"")),
        Value::Array(values) => {
            let texts: Vec<String> = values.iter().map(cell).collect();
            format!("\"{}\"", texts.join(" ").replace('"', "\"\""))
        }
        other => other.to_string(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Serialize)]
    struct Flight {
        why: &'static str,
        time_to_disarm_s: f64,
        touchdown_error_m: Option<f64>,
        for_s: Vec<Option<f64>>,
        seed: u64,
        wind_m_s: f64,
    }

    const FLIGHT: Flight = Flight {
        why: "a \"b\", c",
        time_to_disarm_s: 12.347_499_999_999_998,
        touchdown_error_m: None,
        for_s: Vec::new(),
        seed: u64::MAX,
        wind_m_s: -1e-9,
    };

    #[test]
    fn a_rounded_zero_has_no_sign() {
        assert_eq!(format!("{} {}", rounded(-0.0004, 3), rounded(-0.0016, 3)), "0 -0.002");
    }

    #[test]
    fn columns_are_in_their_order_and_numbers_have_the_digits_that_mean_something() {
        let flight = Flight { for_s: vec![Some(0.5), None], ..FLIGHT };
        assert_eq!(
            csv(&[flight]).unwrap(),
            "why,time_to_disarm_s,touchdown_error_m,for_s,seed,wind_m_s\n\
             \"a \"\"b\"\", c\",12.347,,\"0.5 \",18446744073709551615,0.0\n"
        );
        assert_eq!(
            json_lines(&[FLIGHT]).unwrap(),
            "{\"why\":\"a \\\"b\\\", c\",\"time_to_disarm_s\":12.347,\"touchdown_error_m\":null,\"for_s\":[],\
             \"seed\":18446744073709551615,\"wind_m_s\":0.0}\n"
        );
    }
}
