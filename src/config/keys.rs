//! Access to configuration keys by their dotted names, `section.key`.

use crate::error::{Error, Result};
use std::collections::BTreeMap;

/// Former names of keys, which are still accepted, and their current names.
const RENAMED: [(&str, &str); 6] = [
    ("data.ahead", "data.prefetch"),
    ("data.fewest_context_views", "data.min_context_views"),
    ("data.photo_megabytes", "data.photo_cache_mb"),
    ("train.batch", "train.batch_size"),
    ("train.max_skipped", "train.max_nonfinite_steps"),
    ("train.pictures_every", "train.log_images_every"),
];

/// Former keys that are still accepted, but have no effect any more.
const REMOVED: [&str; 2] = ["data.extents", "data.scene_scales"];

/// Gives every key of `table` its current name, and removes keys without effect. Returns `true` if it removed any.
pub(super) fn rename_former(table: &mut toml::Table) -> bool {
    let mut has_removed = false;
    for (section, key) in REMOVED.map(dotted) {
        if let Some(toml::Value::Table(section)) = table.get_mut(section) {
            has_removed |= section.remove(key).is_some();
        }
    }
    for (former, current) in RENAMED {
        let ((section, former), (_, current)) = (dotted(former), dotted(current));
        if let Some(toml::Value::Table(section)) = table.get_mut(section)
            && let Some(value) = section.remove(former)
        {
            section.insert(current.into(), value);
        }
    }
    has_removed
}

/// Splits `section.key`.
fn dotted(key: &str) -> (&str, &str) {
    key.split_once('.').expect("a section and a key")
}

/// Returns the keys at which two configurations differ, each as "train.batch_size 2 → 4". Both are TOML texts with every key written out.
pub(crate) fn changed_keys(before: &str, after: &str) -> Vec<String> {
    let keys = |text: &str| {
        let mut keys = BTreeMap::new();
        let mut table: toml::Table = text.parse().unwrap_or_default();
        rename_former(&mut table);
        flatten("", toml::Value::Table(table), &mut keys);
        keys
    };
    let (before, after) = (keys(before), keys(after));
    let changed = after.iter().filter_map(|(key, value)| match before.get(key) {
        Some(old) if old == value => None,
        Some(old) => Some(format!("{key} {old} → {value}")),
        None => Some(format!("{key} {value}")),
    });
    changed.collect()
}

/// Collects the values of a table of tables into a map from dotted keys to values.
fn flatten(key: &str, value: toml::Value, into: &mut BTreeMap<String, toml::Value>) {
    match value {
        toml::Value::Table(table) => {
            for (name, value) in table {
                let key = if key.is_empty() { name } else { format!("{key}.{name}") };
                flatten(&key, value, into);
            }
        }
        value => {
            into.insert(key.to_string(), value);
        }
    }
}

/// Sets the key that `assignment`, `section.key=value`, names in `table`.
pub(super) fn override_key(table: &mut toml::Table, assignment: &str) -> Result<()> {
    let refused = || Error::request(format!("--set {assignment}: expected section.key=value"));
    let (key, value) = assignment.split_once('=').ok_or_else(refused)?;
    let value: toml::Value = match format!("value = {value}").parse::<toml::Table>() {
        Ok(mut parsed) => parsed.remove("value").ok_or_else(refused)?,
        Err(_) => toml::Value::String(value.to_string()),
    };
    let key = key.trim();
    if REMOVED.contains(&key) {
        return Ok(());
    }
    let key = RENAMED.iter().find(|(former, _)| *former == key).map_or(key, |(_, current)| current);
    let mut path: Vec<&str> = key.split('.').collect();
    let last = path.pop().ok_or_else(refused)?;
    let mut table = table;
    for section in path {
        let entry = table.entry(section).or_insert_with(|| toml::Value::Table(Default::default()));
        table = entry.as_table_mut().ok_or_else(refused)?;
    }
    table.insert(last.to_string(), value);
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Config;
    use std::path::Path;

    /// A file and an override may each use the former or the current name; the result is the same.
    #[test]
    fn former_keys_are_accepted() {
        for (former, current) in RENAMED {
            let parsed = |in_file: &str, set: &[&str]| {
                let text = match in_file {
                    "" => String::new(),
                    key => format!("[{}]\n{} = 3\n", dotted(key).0, dotted(key).1),
                };
                let set: Vec<String> = set.iter().map(|key| format!("{key}=3")).collect();
                Config::parse(&text, &set, Path::new("a.toml")).expect("a configuration")
            };
            let expected = parsed("", &[current]);
            assert_ne!(expected, parsed("", &[]), "{current}");
            for (in_file, set) in [("", former), (former, former), (former, current), (current, former)] {
                assert_eq!(parsed(in_file, &[set]), expected, "{in_file}, {set}");
            }
            assert_eq!(parsed(former, &[]), expected, "{former}");
            let former_text = expected
                .to_toml()
                .replace(&format!("\n{} = ", dotted(current).1), &format!("\n{} = ", dotted(former).1));
            assert_eq!(changed_keys(&former_text, &expected.to_toml()), [""; 0], "{former}");
        }
    }
    /// Keys without effect are accepted in a file and as an override, even if both name them, and aren't written.
    #[test]
    fn removed_keys_are_ignored() {
        for key in REMOVED {
            let text = format!("[data]\n{} = [0.5, 1]\n", dotted(key).1);
            for set in REMOVED.map(|key| format!("{key}=[2]")) {
                let config = Config::parse(&text, &[set], Path::new("a.toml")).expect("a configuration");
                assert_eq!(config, Config::default());
                assert_eq!(changed_keys(&text, &config.to_toml()), changed_keys("", &config.to_toml()));
                assert!(!config.to_toml().contains("scale"), "{}", config.to_toml());
            }
        }
    }
}
