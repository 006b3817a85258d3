//! GPU resources that kernels use, as reported by the compiler.

/// Resources that one kernel uses on one architecture.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct KernelResources {
    /// Name of the kernel in the source.
    pub name: String,
    /// Number of registers per thread, at most 255.
    pub registers: u32,
    /// Bytes of shared memory per block.
    pub shared: u32,
    /// Bytes of local memory per thread for arrays, which are cached.
    pub stack: u32,
    /// Bytes per thread that are stored and loaded because registers are short.
    pub spills: u32,
}

/// Parses a compiler log and returns the resources of every kernel in it. The format is that of ptxas:
///
/// ```text
/// ptxas info    : Compiling entry function 'gs_blend' for 'sm_90'
/// ptxas         .     0 bytes stack frame, 0 bytes spill stores, 0 bytes spill loads
/// ptxas info    : Used 40 registers, used 0 barriers, 16384 bytes smem
/// ```
pub fn parse_resources(log: &str) -> Vec<KernelResources> {
    let mut kernels: Vec<KernelResources> = vec![];
    for line in log.lines() {
        if let Some(name) = line.split_once("entry function '").and_then(|(_, rest)| rest.split('\'').next())
        {
            kernels.push(KernelResources { name: name.into(), registers: 0, shared: 0, stack: 0, spills: 0 });
        }
        let Some(kernel) = kernels.last_mut() else { continue };
        let (_, line) = line.rsplit_once(" : ").unwrap_or(("", line));
        for part in line.split(", ") {
            let number = part.split_whitespace().find_map(|word| word.parse::<u32>().ok()).unwrap_or(0);
            match part {
                _ if part.ends_with("registers") => kernel.registers = number,
                _ if part.ends_with("bytes smem") => kernel.shared = number,
                _ if part.ends_with("bytes stack frame") => kernel.stack = number,
                _ if part.contains("bytes spill") => kernel.spills += number,
                _ => {}
            }
        }
    }
    kernels
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn resources_are_parsed_from_a_log() {
        let log = "ptxas info    : 244 bytes gmem\n\
                   ptxas info    : Compiling entry function 'gs_blend' for 'sm_90'\n\
                   ptxas info    : Function properties for gs_blend\n\
                   ptxas         .     608 bytes stack frame, 8 bytes spill stores, 12 bytes spill loads\n\
                   ptxas info    : Used 40 registers, used 1 barriers, 16384 bytes smem\n\
                   ptxas info    : Compile time = 17.077 ms\n\
                   ptxas info    : Compiling entry function 'gs_list' for 'sm_90'\n\
                   ptxas info    : Used 20 registers, used 0 barriers, 400 bytes cmem[0]\n";
        let of = |name: &str, registers, shared, stack, spills| KernelResources {
            name: name.into(),
            registers,
            shared,
            stack,
            spills,
        };
        assert_eq!(parse_resources(log), [of("gs_blend", 40, 16384, 608, 20), of("gs_list", 20, 0, 0, 0)]);
    }
}
