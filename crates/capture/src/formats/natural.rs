//! Natural order of names: `r_2` comes before `r_10`.

use std::cmp::Ordering;
use std::ffi::OsStr;

/// Compares names or paths folder by folder. Within a folder's name, runs of digits are compared by their numeric value, however
/// long, and everything else byte by byte. Leading zeros break ties.
pub(super) fn natural_order<Name: AsRef<OsStr> + ?Sized>(a: &Name, b: &Name) -> Ordering {
    let [mut folders_of_a, mut folders_of_b] =
        [a, b].map(|name| name.as_ref().as_encoded_bytes().split(|&byte| byte == b'/'));
    loop {
        // Compare a folder completely, including zeros, before its contents, so that the contents of different folders never
        // interleave.
        match (folders_of_a.next(), folders_of_b.next()) {
            (Some(a), Some(b)) if a == b => {}
            (Some(a), Some(b)) => return tokens(a).cmp(tokens(b)).then_with(|| a.cmp(b)),
            (a, b) => return a.is_some().cmp(&b.is_some()),
        }
    }
}

/// Splits a name into tokens to compare: bytes, and numbers. A number has the byte `0`, its number of digits, and its digits, the
/// latter two without leading zeros.
fn tokens(mut rest: &[u8]) -> impl Iterator<Item = (u8, usize, &[u8])> {
    std::iter::from_fn(move || {
        let digits = rest.iter().take_while(|byte| byte.is_ascii_digit()).count();
        let (token, after) = rest.split_at_checked(digits.max(1))?;
        rest = after;
        if digits == 0 {
            return Some((token[0], 0, &token[..0]));
        }
        let zeros = token.iter().take_while(|&&digit| digit == b'0').count();
        Some((b'0', digits - zeros, &token[zeros..]))
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{Rng, SeedableRng, rngs::StdRng};

    #[test]
    fn numbers_count_and_folders_stay_together() {
        let (nines, googol) = ("9".repeat(100), "1".to_string() + &"0".repeat(100));
        let names = [
            "", "-", "0", "00", "01", "1", "2.png", "10.png", "0099", &nines, &googol, "a", "a/r_2",
            "a/r_10", "a/r_10/b", "a 9", "a 10", "a-b/r_1", "a01/d", "a1/c", "a1/d", "a2", "é2", "é10",
            "写真2", "写真10",
        ];
        for (i, &a) in names.iter().enumerate() {
            for &b in &names[i + 1..] {
                assert_eq!(natural_order(a, b), Ordering::Less, "{a} {b}");
            }
        }
    }

    #[test]
    fn natural_order_is_total() {
        let mut random = StdRng::seed_from_u64(0);
        let letters = ["0", "0", "1", "2", "9", "a", "/", "_", "é", "٣"];
        let names: Vec<String> = (0..150)
            .map(|_| {
                (0..random.random_range(0..6))
                    .map(|_| letters[random.random_range(0..letters.len())])
                    .collect()
            })
            .collect();
        for a in &names {
            for b in &names {
                assert_eq!(natural_order(a, b), natural_order(b, a).reverse(), "{a} {b}");
                assert_eq!(natural_order(a, b).is_eq(), a == b, "{a} {b}");
                for c in names.iter().filter(|_| natural_order(a, b).is_le()) {
                    assert!(natural_order(b, c).is_gt() || natural_order(a, c).is_le(), "{a} {b} {c}");
                }
            }
        }
    }
}
