//! The layers of the architecture: which module may use which, checked against every `use` in `src/`.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// Layers, from the highest to the lowest: a module may use those after it, and those in [`GROUND`].
const LAYERS: [&str; 19] = [
    "cli",
    "parity",
    "bench",
    "refine",
    "eval",
    "train",
    "reconstruct",
    "metrics",
    "config",
    "optim",
    "loss",
    "data",
    "stereo",
    "io",
    "ranks",
    "device",
    "render",
    "model",
    "scene",
];
const GROUND: [&str; 3] = ["scene", "error", "ffi"];

/// Modules of a folder, by path as in "data::loading", and which others of that folder each uses, itself or in its submodules.
type Graph = BTreeMap<String, BTreeSet<String>>;

#[test]
fn modules_use_lower_layers() {
    let sources = sources();
    for module in sources.keys().map(|module| module.split("::").next().unwrap_or_default()) {
        assert!(LAYERS.contains(&module) || GROUND.contains(&module), "{module} has no layer");
    }
    let graph = graph(&sources);
    let layer = |module: &str| LAYERS.iter().position(|name| *name == module);
    let top = graph.iter().filter(|(from, _)| !from.contains("::"));
    let uses: Vec<(&String, &String)> =
        top.flat_map(|(from, used)| used.iter().map(move |to| (from, to))).collect();
    assert!(uses.len() > 60, "{uses:?}: are all of them found?");
    for (from, to) in uses {
        let is_lower = GROUND.contains(&to.as_str()) || layer(from).is_some() && layer(from) < layer(to);
        assert!(is_lower, "{from} uses {to}, which is not below it");
    }
}

/// Items of a `mod.rs` are for the files below it, and these are for it. All other modules of a folder form no cycle.
#[test]
fn modules_of_a_folder_form_no_cycle() {
    let graph = graph(&sources());
    assert!(graph.keys().any(|module| module.starts_with("cli::")), "the program is looked at");
    let left = cycles(graph);
    assert!(left.is_empty(), "cycles, or what uses them: {left:?}");
}

/// Every module has a line in CONTRIBUTING.md, where they come in the order of the layers.
#[test]
fn every_module_is_on_the_page() {
    let page = Path::new(env!("CARGO_MANIFEST_DIR")).join("CONTRIBUTING.md");
    let page = std::fs::read_to_string(&page).expect("CONTRIBUTING.md");
    let mut below = page.as_str();
    for module in LAYERS.into_iter().chain(["error", "ffi"]) {
        let line = below.find(&format!("\n    {module} "));
        let line = line.unwrap_or_else(|| panic!("{module} is not in its place in CONTRIBUTING.md"));
        below = &below[line + 1..];
    }
}

/// Every static and thread-local has a line in CONTRIBUTING.md, which says why it has to be.
#[test]
fn statics_are_on_the_page() {
    let page = Path::new(env!("CARGO_MANIFEST_DIR")).join("CONTRIBUTING.md");
    let page = std::fs::read_to_string(&page).expect("CONTRIBUTING.md");
    let (mut found, mut unlisted) = (0, vec![]);
    for (module, source) in sources() {
        for line in source.lines() {
            let line = line.trim_start().trim_start_matches("pub ").trim_start_matches("pub(crate) ");
            let Some(name) = line.strip_prefix("static ").and_then(|rest| rest.split(':').next()) else {
                continue;
            };
            found += 1;
            if !page.contains(&format!("`{name}`")) {
                unlisted.push(format!("{module}: {name}"));
            }
        }
    }
    assert!(unlisted.is_empty(), "{unlisted:?}");
    assert!(found >= 4, "{found} statics: are all of them found?");
}

/// The library has no command line: what it says names its own arguments, and `src/cli/option_names.rs` names the options.
#[test]
fn the_library_names_no_options() {
    let mut options = vec![];
    for (module, text) in sources() {
        if ["cli", "parity", "bench"].contains(&module.split("::").next().unwrap_or_default()) {
            continue;
        }
        for (at, _) in text.match_indices("--") {
            let (before, after) = (&text[..at], &text[at + 2..]);
            // Variables of style sheets begin with two dashes, too.
            if after.starts_with(|c: char| c.is_ascii_lowercase()) && !before.ends_with("var(") {
                let option: String = after.chars().take_while(|&c| c.is_alphanumeric() || c == '-').collect();
                options.push(format!("{module}: --{option}"));
            }
        }
    }
    assert!(options.is_empty(), "{options:?}");
}

#[test]
fn cycles_and_paths_are_found() {
    let sources =
        |modules: &[(&str, &str)]| modules.iter().map(|(a, b)| (a.to_string(), b.to_string())).collect();
    let graph = |modules: &[(&str, &str)]| graph(&sources(modules));
    let is_cyclic = |modules: &[(&str, &str)]| !cycles(graph(modules)).is_empty();
    let (b, c) = (("b", "use crate::c::C;"), ("c", "fn f() { super::b::g() }"));
    assert!(!is_cyclic(&[("a", "use crate::{b::B, c::C as D};"), b, ("c", "")]));
    assert!(is_cyclic(&[("a", ""), b, c]));
    // A cycle may go through submodules and re-exports, but parents and children may use each other.
    assert!(is_cyclic(&[("b", "use crate::c::d::D;"), ("c", ""), ("c::d", "use super::super::{b};")]));
    assert!(is_cyclic(&[
        ("a", "pub use b::B; pub use c::C;"),
        ("a::b", "use super::C;"),
        ("a::c", "use super::B;")
    ]));
    assert!(!is_cyclic(&[("a", "use b::B; struct A;"), ("a::b", "use super::A;")]));
    let found = paths("use crate::{a::{B, c::D}, E as F};\nlet x = super::g::h();");
    for path in ["crate::a::B", "crate::a::c::D", "crate::E", "super::g::h"] {
        assert!(found.iter().any(|found| found == path), "{path}: {found:?}");
    }
    assert_eq!(
        code("a; // crate::b\n/// crate::c\nd(\"a://\");\n#[cfg(test)]\nmod tests { crate::e }"),
        "a;\n\nd(\"a://\");\n"
    );
}

/// Removes modules that use none of the others, again and again. Returns what is left: cycles, and what uses them.
fn cycles(mut graph: Graph) -> Graph {
    loop {
        let all: BTreeSet<String> = graph.keys().cloned().collect();
        graph.retain(|_, used| !used.is_disjoint(&all));
        if graph.len() == all.len() {
            return graph;
        }
    }
}

fn graph(sources: &BTreeMap<String, String>) -> Graph {
    let paths: BTreeMap<&str, Vec<String>> =
        sources.iter().map(|(name, text)| (name.as_str(), paths(text))).collect();
    let mut graph = Graph::new();
    for (module, used) in paths.iter().flat_map(|(module, used)| used.iter().map(move |path| (module, path)))
    {
        let from: Vec<&str> = module.split("::").collect();
        let to = resolve(&paths, module, used).unwrap_or_default();
        let to: Vec<&str> = to.split("::").collect();
        let shared = from.iter().zip(&to).take_while(|(a, b)| a == b).count();
        if shared < from.len().min(to.len()) && from != [""] && to != [""] {
            graph.entry(from[..=shared].join("::")).or_default().insert(to[..=shared].join("::"));
        }
    }
    graph
}

/// Returns the file that defines the item that `path` names in `module`; re-exports by a parent are followed.
fn resolve(paths: &BTreeMap<&str, Vec<String>>, module: &str, path: &str) -> Option<String> {
    let mut at: Vec<&str> = module.split("::").filter(|name| !name.is_empty()).collect();
    for (index, name) in path.split("::").enumerate() {
        match name {
            // `globalsplat` is the library's name in the program.
            "crate" | "globalsplat" if index == 0 => at.clear(),
            "self" => {}
            "super" => drop(at.pop()),
            _ => {
                let parent = at.join("::");
                at.push(name);
                if !paths.contains_key(at.join("::").as_str()) {
                    let is_child = |path: &str| {
                        let first = path.split("::").next().unwrap_or_default();
                        paths.contains_key([&parent, "::", first].concat().as_str())
                    };
                    let exports = paths.get(parent.as_str()).into_iter().flatten();
                    let export = exports
                        .filter(|path| path.rsplit("::").next() == Some(name))
                        .find(|path| is_child(path));
                    let defined = export.and_then(|path| resolve(paths, &parent, path));
                    return defined.or((index > 0).then_some(parent));
                }
            }
        }
    }
    Some(at.join("::"))
}

/// Returns all `use`d paths, with braces expanded, and all paths in the code that begin with `crate`, `super` or `globalsplat`.
fn paths(code: &str) -> Vec<String> {
    let is_path = |c: char| c.is_alphanumeric() || c == '_' || c == ':';
    let is_ours =
        |word: &&str| ["crate::", "super::", "globalsplat::"].iter().any(|start| word.starts_with(start));
    let inline = code.split(|c| !is_path(c)).filter(is_ours);
    let mut found: Vec<String> = inline.map(String::from).collect();
    for (at, _) in code.match_indices("use ") {
        let (mut prefixes, mut name) = (vec![String::new()], String::new());
        for c in code[at + "use ".len()..].chars().take_while(|&c| c != ';').chain([' ']) {
            if is_path(c) {
                name.push(c);
                continue;
            }
            let path = prefixes.last().cloned().unwrap_or_default() + &std::mem::take(&mut name);
            match c {
                '{' => prefixes.push(path),
                _ => found.push(path),
            }
            if c == '}' {
                prefixes.pop();
            }
        }
    }
    found.into_iter().map(|path| path.trim_end_matches(':').to_string()).collect()
}

/// Returns the source without comments and without tests, which may use anything.
fn code(text: &str) -> String {
    let text = text.split("#[cfg(test)]\nmod tests").next().unwrap_or_default();
    let without = |line: &str| {
        let is_comment = |at: usize| line[..at].trim_end().len() < at || at == 0;
        let comment = line.match_indices("//").map(|(at, _)| at).find(|&at| is_comment(at));
        line[..comment.unwrap_or(line.len())].trim_end().to_string() + "\n"
    };
    text.lines().map(without).collect()
}

/// Returns the files in `place`, or `place` itself if it is a file. Skips hidden files, Python's caches and third-party modules.
pub fn files(place: &Path) -> Vec<PathBuf> {
    let Ok(entries) = std::fs::read_dir(place) else { return vec![place.to_owned()] };
    let entries = entries.map(|entry| entry.expect("a readable entry").path());
    let is_ours = |path: &PathBuf| {
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        !name.starts_with('.') && name != "__pycache__" && name != "node_modules"
    };
    entries.filter(is_ours).flat_map(|path| files(&path)).collect()
}

/// Returns the code of each module of the library and of the program, by path. Tests may use anything.
fn sources() -> BTreeMap<String, String> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let of = |file: PathBuf| {
        let name = file.strip_prefix(&root).ok()?.to_str()?.strip_suffix(".rs")?.replace('/', "::");
        let module = name.strip_suffix("::mod").unwrap_or(&name).to_string();
        let text = std::fs::read_to_string(&file).expect("a file");
        let is_checked = !["lib", "main"].contains(&module.as_str()) && !module.ends_with("_tests");
        is_checked.then(|| (module, code(&text)))
    };
    files(&root).into_iter().filter_map(of).collect()
}
