//! Configurations generated from valid keys, and settings of the command line.

use arbitrary::{Arbitrary, Unstructured};
use globalsplat::config::Config;
use std::path::Path;

#[derive(Arbitrary)]
enum Value {
    Whole(i64),
    Small(u8),
    Number(f64),
    Truth(bool),
    Text(String),
    Wholes(Vec<i16>),
    Texts(Vec<String>),
    /// The key's own default.
    Default,
    Any(String),
}

impl Value {
    fn toml(&self, default: &toml::Value) -> String {
        match self {
            Value::Whole(value) => value.to_string(),
            Value::Small(value) => value.to_string(),
            Value::Number(value) => toml::Value::from(*value).to_string(),
            Value::Truth(value) => value.to_string(),
            Value::Text(value) => toml::Value::from(value.as_str()).to_string(),
            Value::Wholes(values) => {
                toml::Value::from(values.iter().map(|&v| i64::from(v)).collect::<Vec<_>>()).to_string()
            }
            Value::Texts(values) => toml::Value::from(values.clone()).to_string(),
            Value::Default => default.to_string(),
            Value::Any(text) => text.clone(),
        }
    }
}

#[derive(Arbitrary)]
struct Made {
    /// Entries of the file, each with the index of its key.
    file: Vec<(u8, Value)>,
    settings: Vec<(Result<u8, String>, Value)>,
}

/// Returns every key, with its default.
fn keys() -> Vec<(String, String, toml::Value)> {
    let defaults: toml::Table = Config::default().to_toml().parse().unwrap();
    let mut keys = vec![];
    for (section, value) in defaults {
        for (key, default) in value.as_table().unwrap() {
            keys.push((section.clone(), key.clone(), default.clone()));
        }
    }
    keys
}

pub fn configuration(bytes: &[u8]) {
    let Ok(made) = Made::arbitrary(&mut Unstructured::new(bytes)) else { return };
    thread_local!(static KEYS: Vec<(String, String, toml::Value)> = keys());
    KEYS.with(|keys| {
        let key = |index: u8| &keys[usize::from(index) % keys.len()];
        let mut file = String::new();
        for (index, value) in &made.file {
            let (section, name, default) = key(*index);
            file += &format!("{section}.{name} = {}\n", value.toml(default));
        }
        let setting = |(name, value): &(Result<u8, String>, Value)| match name {
            Ok(index) => {
                let (section, name, default) = key(*index);
                format!("{section}.{name}={}", value.toml(default))
            }
            Err(name) => format!("{name}={}", value.toml(&toml::Value::Boolean(true))),
        };
        let settings: Vec<String> = made.settings.iter().map(setting).collect();
        let Ok(config) = Config::parse(&file, &settings, Path::new("config.toml")) else { return };
        let _ = (config.data.capture_paths(), config.data.validation_paths());
        // A run stores the resolved configuration and resumes with it.
        assert_eq!(Config::parse(&config.to_toml(), &[], Path::new("again")).unwrap(), config);
    });
}
