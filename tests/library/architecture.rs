//! The layers of the architecture: which module may use which, checked against every `use` in `src/`.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// Layers, from the highest to the lowest: a module may use those after it, and those in [`GROUND`].
const LAYERS: [&str; 17] = [
    "cli",
    "parity",
    "bench",
    "refine",
    "eval",
    "train",
    "reconstruct",
    "config",
    "optim",
    "loss",
    "data",
    "io",
    "ranks",
    "device",
    "render",
    "model",
    "scene",
];
const GROUND: [&str; 3] = ["scene", "error", "ffi"];

/// Path of a module, as ["data", "formats", "colmap"].
type Module = Vec<String>;

struct Source {
    /// Source code without comments and tests.
    text: String,
    /// `true` for a `mod.rs`, or `lib.rs`.
    is_parent: bool,
}

#[test]
fn modules_use_only_lower_layers() {
    let sources = sources();
    for module in
        sources.keys().filter(|module| module.len() == 1 && !["error", "ffi"].contains(&module[0].as_str()))
    {
        assert!(LAYERS.contains(&module[0].as_str()), "{} has no layer", module[0]);
    }
    let floor = |module: &Module| LAYERS.iter().position(|name| *name == module[0]);
    let mut arrows = 0;
    for (from, to) in dependencies(&sources) {
        if from.is_empty() || from[0] == to[0] || GROUND.contains(&to[0].as_str()) {
            continue;
        }
        assert!(floor(&from) < floor(&to), "{} uses {}, which is above it", from.join("::"), to.join("::"));
        arrows += 1;
    }
    assert!(arrows > 100, "{arrows} arrows: are all of them found?");
}

/// No modules of one folder, each with all its submodules, use each other in a cycle, directly or indirectly. Items of a
/// `mod.rs` are for the files below it, and these are for it.
#[test]
fn modules_have_no_dependency_cycles() {
    let graph = siblings(dependencies(&sources()));
    assert!(graph.keys().any(|module| module.starts_with(&["cli".to_string()])), "the program is looked at");
    if let Some(circle) = circle(&graph) {
        let names: Vec<String> = circle.iter().map(|module| module.join("::")).collect();
        panic!("a circle: {}", names.join(" → "));
    }
}

/// Every module has a box in the figure, and a line in CONTRIBUTING.md, where they come in the order of the layers.
#[test]
fn every_module_is_in_the_diagram_and_on_the_page() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let [figure, page] = ["docs/architecture.svg", "CONTRIBUTING.md"]
        .map(|file| std::fs::read_to_string(root.join(file)).unwrap_or_else(|e| panic!("{file}: {e}")));
    let mut below = page.as_str();
    for module in LAYERS.into_iter().chain(["error", "ffi"]) {
        assert!(figure.contains(&format!(">{module}</tspan>")), "docs/architecture.svg has no box {module}");
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
        for line in source.text.lines() {
            let line = line.trim_start().trim_start_matches("pub ").trim_start_matches("pub(crate) ");
            let Some(name) = line.strip_prefix("static ").and_then(|rest| rest.split(':').next()) else {
                continue;
            };
            found += 1;
            if !page.contains(&format!("`{name}`")) {
                unlisted.push(format!("{}: {name}", module.join("::")));
            }
        }
    }
    assert!(unlisted.is_empty(), "{unlisted:?}");
    assert!(found >= 6, "{found} statics: are all of them found?");
}

/// The library has no command line: what it says names its own arguments, and `src/cli/option_names.rs` names the options.
#[test]
fn the_library_names_no_options() {
    let mut options = vec![];
    for (module, source) in sources() {
        if module.first().is_some_and(|layer| ["cli", "parity", "bench"].contains(&layer.as_str())) {
            continue;
        }
        for (at, _) in source.text.match_indices("--") {
            let (before, after) = (&source.text[..at], &source.text[at + 2..]);
            // Variables of style sheets begin with two dashes, too.
            if after.starts_with(|c: char| c.is_ascii_lowercase()) && !before.ends_with("var(") {
                let option: String = after.chars().take_while(|&c| c.is_alphanumeric() || c == '-').collect();
                options.push(format!("{}: --{option}", module.join("::")));
            }
        }
    }
    assert!(options.is_empty(), "{options:?}");
}

#[test]
fn circles_and_paths_are_found() {
    let module = |path: &str| path.split("::").map(String::from).collect::<Module>();
    let graph = |arrows: &[(&str, &str)]| siblings(arrows.iter().map(|(a, b)| (module(a), module(b))));
    assert!(circle(&graph(&[("a", "b"), ("b", "c"), ("a", "c")])).is_none());
    assert_eq!(circle(&graph(&[("a", "b"), ("b", "c"), ("c", "b")])).map(|circle| circle.len()), Some(3));
    // A cycle may go through submodules, but parents and children may use each other.
    assert!(circle(&graph(&[("a::b", "a::c"), ("a::c::d", "a::b"), ("a", "e")])).is_some());
    assert!(circle(&graph(&[("a", "a::b"), ("a::b", "a::c::d"), ("a::c::d", "a")])).is_none());
    let text = "use crate::{a::{B, c::D}, E as F};\nlet x = super::g::h();";
    assert_eq!(paths(text), ["crate::a::B", "crate::a::c::D", "crate::E", "super::g::h"]);
    assert_eq!(
        code("a; // crate::b\n/// crate::c\nd(\"//\");\n#[cfg(test)]\nmod tests { crate::e }"),
        "a; \n\nd(\"//\");\n"
    );
}

/// Returns pairs (user, used), where `used` is the file that defines the item.
fn dependencies(sources: &BTreeMap<Module, Source>) -> BTreeSet<(Module, Module)> {
    let mut arrows = BTreeSet::new();
    for (module, source) in sources {
        for path in paths(&source.text) {
            let path: Vec<&str> = path.split("::").collect();
            if let Some(used) =
                resolve(sources, module, &path).filter(|used| used != module && !used.is_empty())
            {
                arrows.insert((module.clone(), used));
            }
        }
    }
    arrows
}

/// Returns the file that defines the item that `path` names in `module`; re-exports are followed.
fn resolve(sources: &BTreeMap<Module, Source>, module: &Module, path: &[&str]) -> Option<Module> {
    let mut at = match path[0] {
        // `globalsplat` is the library's name in the program.
        "crate" | "globalsplat" => vec![],
        "super" | "self" => module.clone(),
        child => [module.clone(), vec![child.to_string()]].concat(),
    };
    let mut rest = &path[1..];
    if path[0] == "super" {
        at.pop();
    }
    while let Some((&first, others)) = rest.split_first() {
        let below = [at.clone(), vec![first.to_string()]].concat();
        match first {
            "super" => drop(at.pop()),
            _ if sources.contains_key(&below) => at = below,
            item => return re_exported(sources, &at, item).or(Some(at)),
        }
        rest = others;
    }
    sources.contains_key(&at).then_some(at)
}

/// Returns the module that defines `item`, if `module` is a parent that only re-exports it.
fn re_exported(sources: &BTreeMap<Module, Source>, module: &Module, item: &str) -> Option<Module> {
    let source = sources.get(module).filter(|source| source.is_parent)?;
    let exports = paths(&source.text).into_iter().filter(|path| path.ends_with(&format!("::{item}")));
    exports.into_iter().find_map(|path| {
        let path: Vec<&str> = path.split("::").collect();
        let own_child = [module.clone(), vec![path[0].to_string()]].concat();
        sources.contains_key(&own_child).then(|| resolve(sources, module, &path)).flatten()
    })
}

/// Returns which modules of a folder use which others of that folder, for themselves or for their submodules.
fn siblings(arrows: impl IntoIterator<Item = (Module, Module)>) -> BTreeMap<Module, BTreeSet<Module>> {
    let mut graph: BTreeMap<Module, BTreeSet<Module>> = BTreeMap::new();
    for (from, to) in arrows {
        let shared = from.iter().zip(&to).take_while(|(a, b)| a == b).count();
        if shared < from.len().min(to.len()) {
            graph.entry(from[..=shared].to_vec()).or_default().insert(to[..=shared].to_vec());
        }
    }
    graph
}

/// Returns a cycle of modules, each of which uses the next, and the last the first.
fn circle(graph: &BTreeMap<Module, BTreeSet<Module>>) -> Option<Vec<Module>> {
    fn visit(
        graph: &BTreeMap<Module, BTreeSet<Module>>,
        at: &Module,
        path: &mut Vec<Module>,
        done: &mut BTreeSet<Module>,
    ) -> Option<Vec<Module>> {
        if let Some(start) = path.iter().position(|module| module == at) {
            return Some([&path[start..], std::slice::from_ref(at)].concat());
        }
        if done.contains(at) {
            return None;
        }
        path.push(at.clone());
        let found = graph.get(at).into_iter().flatten().find_map(|next| visit(graph, next, path, done));
        path.pop();
        done.insert(at.clone());
        found
    }
    let mut done = BTreeSet::new();
    graph.keys().find_map(|start| visit(graph, start, &mut vec![], &mut done))
}

/// Returns all `use`d paths, with braces expanded, and all paths in the code that begin with `crate`, `super` or `globalsplat`.
fn paths(text: &str) -> Vec<String> {
    let mut found = vec![];
    let mut rest = text;
    while let Some((start, is_use)) = next_path(rest) {
        rest = &rest[start..];
        let is_end = |c: char| match is_use {
            true => c == ';',
            false => !(c.is_alphanumeric() || c == '_' || c == ':'),
        };
        let end = rest.find(is_end).unwrap_or(rest.len());
        expand("", rest[..end].trim(), &mut found);
        rest = &rest[end..];
    }
    found
}

/// Returns the offset of the next path, and `true` if it is a `use`.
fn next_path(text: &str) -> Option<(usize, bool)> {
    let inline = ["crate::", "super::", "globalsplat::"].iter().filter_map(|start| text.find(start)).min();
    let used = text.find("use ").map(|at| at + "use ".len());
    match (used, inline) {
        (Some(used), Some(inline)) if inline < used => Some((inline, false)),
        (Some(used), _) => Some((used, true)),
        (None, inline) => inline.map(|at| (at, false)),
    }
}

/// Expands `a::{b, c::{d, e}}` to `a::b`, `a::c::d`, `a::c::e`, each prefixed with `prefix`.
fn expand(prefix: &str, tree: &str, into: &mut Vec<String>) {
    let tree = tree.trim();
    match tree.split_once('{') {
        None => {
            let name = tree.split(" as ").next().unwrap_or_default().trim_end_matches(':').trim();
            if !name.is_empty() {
                into.push(format!("{prefix}{name}"));
            }
        }
        Some((head, inside)) => {
            let inside = inside.trim_end().strip_suffix('}').unwrap_or(inside);
            let (mut depth, mut start) = (0, 0);
            for (i, c) in inside.char_indices().chain([(inside.len(), ',')]) {
                match c {
                    '{' => depth += 1,
                    '}' => depth -= 1,
                    ',' if depth == 0 => {
                        expand(&format!("{prefix}{head}"), &inside[start..i], into);
                        start = i + 1;
                    }
                    _ => {}
                }
            }
        }
    }
}

/// Returns the source without comments and without tests, which may use anything.
fn code(text: &str) -> String {
    let text = text.split("#[cfg(test)]\nmod tests").next().unwrap_or_default();
    let without = |line: &str| {
        let quoted = |at: usize| line[..at].matches('"').count() % 2 == 1;
        let comment = line.match_indices("//").map(|(at, _)| at).find(|&at| !quoted(at));
        line[..comment.unwrap_or(line.len())].to_string() + "\n"
    };
    text.lines().map(without).collect()
}

/// Returns the source files of the library and of the program.
fn sources() -> BTreeMap<Module, Source> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let mut files: Vec<PathBuf> = vec![];
    let mut folders = vec![root.clone()];
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(&folder).expect("a folder") {
            let path = entry.expect("an entry").path();
            match path.is_dir() {
                true => folders.push(path),
                false => files.push(path),
            }
        }
    }
    let mut sources = BTreeMap::new();
    for file in files.iter().filter(|file| file.extension().is_some_and(|ending| ending == "rs")) {
        let inside = file.strip_prefix(&root).expect("a file in src").with_extension("");
        let mut module: Module = inside.iter().map(|part| part.to_string_lossy().into_owned()).collect();
        let name = module.last().cloned().unwrap_or_default();
        // Tests may use anything.
        if module[0] == "main" || name.ends_with("_tests") {
            continue;
        }
        let is_parent = name == "mod" || name == "lib";
        if is_parent {
            module.pop();
        }
        let text = code(&std::fs::read_to_string(file).expect("a file"));
        sources.insert(module, Source { text, is_parent });
    }
    sources
}
