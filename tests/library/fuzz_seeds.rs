//! Fuzzing seeds and former failures are read again by every reader: see `scripts/fuzz.sh`.

#[path = "../common/readers/mod.rs"]
mod readers;

use std::path::Path;

#[test]
fn seeds_crash_no_reader() {
    let seeds = Path::new(env!("CARGO_MANIFEST_DIR")).join("fuzz/seeds");
    for (name, read) in readers::READERS {
        let files = std::fs::read_dir(seeds.join(name)).into_iter().flatten();
        let mut files: Vec<_> = files.map(|entry| entry.unwrap().path()).collect();
        files.sort();
        assert!(!files.is_empty(), "{name} has no seeds");
        for file in files {
            println!("{}", file.display());
            read(&std::fs::read(&file).unwrap());
        }
    }
    std::fs::remove_dir_all(readers::root()).unwrap();
}

#[test]
fn every_reader_has_a_fuzz_target() {
    let manifest = Path::new(env!("CARGO_MANIFEST_DIR")).join("fuzz/Cargo.toml");
    let manifest = std::fs::read_to_string(manifest).unwrap();
    for (name, _) in readers::READERS {
        assert!(manifest.contains(&format!("name = \"{name}\"")), "{name}");
    }
}

/// fuzz/Cargo.lock locks exactly the dependencies that the two manifests name; if one is missing, `cargo fuzz build` picks an
/// untested version, or fails without a network.
#[test]
fn lock_file_of_the_fuzz_targets_is_up_to_date() {
    let read = |path: &str| {
        let text = std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join(path)).unwrap();
        text.parse::<toml::Table>().unwrap()
    };
    let lock = read("fuzz/Cargo.lock");
    for (manifest, name) in [("Cargo.toml", "globalsplat"), ("csrc/Cargo.toml", "globalsplat-csrc")] {
        let mut packages = lock["package"].as_array().unwrap().iter();
        let package = packages.find(|package| package["name"].as_str() == Some(name)).unwrap();
        // A name, followed by its version if several are locked.
        let locked: Vec<&str> = package["dependencies"]
            .as_array()
            .unwrap()
            .iter()
            .map(|dependency| dependency.as_str().unwrap().split(' ').next().unwrap())
            .collect();
        let manifest = read(manifest);
        let tables = ["dependencies", "build-dependencies"]
            .iter()
            .filter_map(|table| manifest.get(*table)?.as_table());
        let named: Vec<_> = tables.flatten().collect();
        for package in &locked {
            let is_named = named.iter().any(|(dependency, _)| dependency.as_str() == *package);
            assert!(is_named, "{name} does not need {package}");
        }
        for (dependency, details) in named {
            let is_optional =
                details.get("optional").is_some_and(|optional| optional.as_bool() == Some(true));
            assert!(is_optional || locked.contains(&dependency.as_str()), "{name} needs {dependency}");
        }
    }
}
