//! Distributed processes (ranks) that work together, on one machine or on many. `torchrun` starts them, and libtorch's c10d connects them.
//! A program that runs alone is the only rank of its group; all collectives are then no-ops.

mod env;
mod process_group;

pub use env::{DistributedEnv, Rendezvous};
pub use globalsplat_csrc::distributed::{has_gloo, has_nccl};
pub use process_group::{ProcessGroup, is_communication_error};

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use globalsplat_csrc::distributed as ffi;
    use std::net::TcpListener;
    use std::sync::Barrier;
    use tch::{Device, Kind, Tensor};

    /// Runs `work` on every rank of a group of `ranks` ranks, each in its own thread, and returns the results.
    pub(crate) fn run_on_ranks<T: Send>(ranks: usize, work: impl Fn(ProcessGroup) -> T + Sync) -> Vec<T> {
        let port =
            TcpListener::bind("127.0.0.1:0").and_then(|socket| socket.local_addr()).expect("a port").port();
        // A rank that leaves before all ranks have joined would fail the join, not the test.
        let have_met = Barrier::new(ranks);
        std::thread::scope(|scope| {
            let rank = |rank| {
                let (have_met, work) = (&have_met, &work);
                let host = "127.0.0.1".into();
                let env = DistributedEnv {
                    rank,
                    ranks,
                    local_rank: rank,
                    local_world_size: ranks,
                    restarts: 0,
                    host,
                    port,
                    is_agent_store: false,
                };
                scope.spawn(move || {
                    let rendezvous = Rendezvous::connect(env).expect("a store");
                    let group = ProcessGroup::join(&rendezvous, Device::Cpu);
                    have_met.wait();
                    work(group.expect("a group"))
                })
            };
            let threads: Vec<_> = (0..ranks).map(rank).collect();
            threads.into_iter().map(|thread| thread.join().expect("a rank")).collect()
        })
    }

    /// Returns `true` if ranks can communicate in this build. Otherwise prints that the test is skipped.
    pub(crate) fn require_gloo() -> bool {
        if !ffi::has_gloo() {
            globalsplat_test_kit::skip("Gloo", "built without Gloo (libgloo-dev)");
        }
        ffi::has_gloo()
    }

    #[test]
    fn collectives_return_the_expected_values() {
        if !require_gloo() {
            return;
        }
        for ranks in [2, 3] {
            let found = run_on_ranks(ranks, |group| {
                let number = group.rank() as f32 + 1.;
                let sum = Tensor::full([2, 3], f64::from(number), (Kind::Float, Device::Cpu));
                group.all_reduce(&sum).expect("a sum");
                let copy = Tensor::from_slice(&[number]);
                group.broadcast(&copy).expect("a copy");
                // A list of a different length on each rank, a NaN, and a nested `None`, which JSON can't represent.
                let value = (vec![group.rank(); group.rank()], f64::NAN, Some(None::<u64>));
                let gathered = group.all_gather_object(value).expect("values");
                let first =
                    group.broadcast_object(group.is_main_process().then_some(None::<u64>)).expect("a value");
                (Vec::<f32>::try_from(sum.view(-1)).unwrap(), copy.double_value(&[0]), gathered, first)
            });
            let expected = (1..=ranks).sum::<usize>() as f32;
            for (sum, copy, gathered, first) in found {
                assert_eq!(sum, vec![expected; 6]);
                assert_eq!(copy, 1.);
                assert_eq!(first, None);
                for (rank, (list, number, _)) in gathered.iter().enumerate() {
                    assert!(*list == vec![rank; rank] && number.is_nan(), "{gathered:?}");
                }
            }
        }
    }

    #[test]
    fn gradients_are_summed_and_those_that_a_rank_lacks_count_as_0() {
        if !require_gloo() {
            return;
        }
        let found = run_on_ranks(3, |group| {
            let leaf =
                |size: [i64; 2]| Tensor::ones(size, (Kind::Float, Device::Cpu)).set_requires_grad(true);
            let leaves = [leaf([5, 1]), leaf([1, 3]), leaf([2, 2])];
            // The third leaf has a gradient on the second rank alone, and the second leaf has none on the last rank.
            let used = [&leaves[..1], &leaves, &leaves[..1]][group.rank()];
            used.iter().for_each(|leaf| (leaf * (group.rank() + 1) as f64).sum(Kind::Float).backward());
            let count = group.all_reduce_gradients(&leaves).expect("sums");
            let sums = used.iter().map(|leaf| (leaf.grad().size(), leaf.grad().double_value(&[0, 0])));
            (count, sums.collect::<Vec<_>>())
        });
        let [first, second, third] = [(vec![5, 1], 6.), (vec![1, 3], 2.), (vec![2, 2], 2.)];
        assert_eq!(
            found,
            [(1, vec![first.clone()]), (3, vec![first.clone(), second, third]), (1, vec![first])]
        );
    }

    #[test]
    fn nccl_is_found_in_libtorch() {
        // NCCL is in libtorch's CUDA library, with or without a GPU.
        // SAFETY: the name is a terminated string, and the library's initializers only register themselves with libtorch.
        let cuda = unsafe { libc::dlopen(c"libtorch_cuda.so".as_ptr(), libc::RTLD_NOW | libc::RTLD_GLOBAL) };
        let without = !cuda.is_null() && !ffi::has_nccl();
        assert!(!without || std::env::var_os("GLOBALSPLAT_NO_SKIPS").is_none(), "built without NCCL");
        if cuda.is_null() || !ffi::has_nccl() || tch::Cuda::device_count() > 0 {
            eprintln!("skipped: NCCL without a GPU: not in this build, or there is one");
            return;
        }
        let store = ffi::connect("127.0.0.1", 0, true, "test", 60).expect("a store");
        // The error comes from NCCL's constructor. So it was found and called, and its exception is passed through.
        let error = ffi::new_group(true, &store, 0, 1, 60).err().expect("no GPU").to_string();
        assert!(error.contains("no GPUs found"), "{error}");
    }
}
