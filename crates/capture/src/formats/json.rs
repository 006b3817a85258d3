//! Support for JSON as Python writes it.

/// Replaces NaN, Infinity and −Infinity outside of strings by null.
pub(super) fn replace_nan_with_null(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    let mut rest = text;
    let (mut in_string, mut escaped) = (false, false);
    while let Some(c) = rest.chars().next() {
        if !in_string
            && let Some(token) = ["NaN", "Infinity", "-Infinity"].iter().find(|t| rest.starts_with(**t))
        {
            out.push_str("null");
            rest = &rest[token.len()..];
            continue;
        }
        match c {
            '"' if !escaped => in_string = !in_string,
            _ => {}
        }
        escaped = in_string && c == '\\' && !escaped;
        out.push(c);
        rest = &rest[c.len_utf8()..];
    }
    out
}

#[cfg(test)]
mod tests {
    use super::replace_nan_with_null;

    #[test]
    fn only_numbers_are_replaced() {
        let text = r#"{"NaN \" NaN": [NaN, -Infinity, 1.5], "b": Infinity}"#;
        assert_eq!(replace_nan_with_null(text), r#"{"NaN \" NaN": [null, null, 1.5], "b": null}"#);
    }
}
