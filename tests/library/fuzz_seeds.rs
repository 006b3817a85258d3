//! Fuzzing seeds and former failures are read again by every reader: see `scripts/fuzz.sh`.

#[path = "../common/readers.rs"]
mod readers;

use std::fs::{self, File};
use std::io::Read;
use std::path::Path;

#[test]
fn seeds_crash_no_reader() {
    let seeds = File::open(Path::new(env!("CARGO_MANIFEST_DIR")).join("fuzz/seeds.zip")).unwrap();
    let mut seeds = zip::ZipArchive::new(seeds).unwrap();
    for (name, read) in readers::READERS {
        let prefix = format!("{name}/");
        let own: Vec<String> =
            seeds.file_names().filter(|seed| seed.starts_with(&prefix)).map(String::from).collect();
        assert!(!own.is_empty(), "{name} has no seeds");
        for seed in own {
            println!("{seed}");
            let mut bytes = vec![];
            seeds.by_name(&seed).unwrap().read_to_end(&mut bytes).unwrap();
            read(&bytes);
        }
    }
    fs::remove_dir_all(readers::root()).unwrap();
}
