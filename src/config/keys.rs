//! Access to configuration keys by their dotted names, `section.key`.

use crate::error::{Error, Result};
use std::collections::BTreeMap;

/// Returns the keys at which two configurations differ, each as "train.batch_size 2 → 4". Both are TOML texts with every key written out.
pub(crate) fn changed_keys(before: &str, after: &str) -> Vec<String> {
    let keys = |text: &str| {
        let mut keys = BTreeMap::new();
        let table: toml::Table = text.parse().unwrap_or_default();
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
    let mut path: Vec<&str> = key.trim().split('.').collect();
    let last = path.pop().ok_or_else(refused)?;
    let mut table = table;
    for section in path {
        let entry = table.entry(section).or_insert_with(|| toml::Value::Table(Default::default()));
        table = entry.as_table_mut().ok_or_else(refused)?;
    }
    table.insert(last.to_string(), value);
    Ok(())
}
