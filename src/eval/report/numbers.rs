//! Formatting of numbers for readers.

use maud::{Markup, html};

/// Formats an integer with thousands separators: `5601` as `5,601`.
pub fn thousands(value: u64) -> String {
    let digits = value.to_string();
    let mut text = String::new();
    for (i, digit) in digits.chars().enumerate() {
        if i > 0 && (digits.len() - i).is_multiple_of(3) {
            text.push(',');
        }
        text.push(digit);
    }
    text
}

/// Formats a number with `digits` decimal places and thousands separators.
pub fn decimal(value: f64, digits: usize) -> String {
    let text = format!("{:.digits$}", value.abs());
    let (whole, rest) = text.split_at(text.find('.').unwrap_or(text.len()));
    let sign = if value < 0. && text.contains(|c: char| ('1'..='9').contains(&c)) { "−" } else { "" };
    format!("{sign}{}{rest}", whole.parse().map_or(whole.to_string(), thousands))
}

/// Formats a number with one decimal place, or with none if it is a whole number or at least 100: `16.4`, `393`, `0.1`.
pub fn short(value: f64) -> String {
    decimal(value, if value.fract() == 0. || value.abs() >= 100. { 0 } else { 1 })
}

/// Returns `value` if it is finite. The mean over no scenes is not a number.
pub fn mean(value: f64) -> Option<f64> {
    Some(value).filter(|value| value.is_finite())
}

/// Formats a count with its noun, such as `1 scene` or `5,601 scenes`.
pub fn count(number: usize, one: &str) -> String {
    format!("{} {one}{}", thousands(number as u64), if number == 1 { "" } else { "s" })
}

/// Renders the word for a value that was not measured or not published. An empty cell or a zero could be mistaken for a result.
pub fn absent() -> Markup {
    html! { span.absent { "absent" } }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_formatted() {
        assert_eq!(thousands(5601), "5,601");
        assert_eq!(thousands(123), "123");
        assert_eq!(thousands(4_064_762), "4,064,762");
        assert_eq!(decimal(1234.567, 2), "1,234.57");
        assert_eq!(decimal(-0.5, 1), "−0.5");
        assert_eq!(decimal(-0.001, 2), "0.00");
        assert_eq!(
            (short(16.384), short(393.), short(0.1), short(2359.4)),
            ("16.4".into(), "393".into(), "0.1".into(), "2,359".into())
        );
        assert_eq!((count(1, "scene"), count(5601, "scene")), ("1 scene".into(), "5,601 scenes".into()));
    }
}
