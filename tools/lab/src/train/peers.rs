//! Connects this process with the others of a training: those that a launcher of MPI started, with
//! the feature `mpi`, or none.
//!
//! Message size: four bytes a parameter for each group of scenes. Every rank receives the messages of
//! all ranks by one broadcast each, which needs no memory beyond the messages. `mpirun` ends all ranks
//! where one is killed and names it; the training goes on from its last checkpoint.

use super::ranks::Peers;
use super::{Error, Result};

/// Connects with the other ranks that the launcher started. One process without a launcher is alone.
///
/// # Errors
/// MPI that cannot be initialised.
#[cfg(feature = "mpi")]
pub fn connect() -> Result<Box<dyn Peers>> {
    Ok(Box::new(over_mpi::Mpi::connect()?))
}

/// Variables in which launchers of MPI state the number of processes: Open MPI; MPICH and Intel MPI;
/// Slurm.
#[cfg(not(feature = "mpi"))]
const COUNTS: [&str; 3] = ["OMPI_COMM_WORLD_SIZE", "PMI_SIZE", "SLURM_STEP_NUM_TASKS"];

/// Returns one process alone, because this program was built without MPI.
///
/// # Errors
/// A launcher of MPI that started several processes: each would take all steps.
#[cfg(not(feature = "mpi"))]
pub fn connect() -> Result<Box<dyn Peers>> {
    let count = |name: &&str| -> Option<usize> { std::env::var(name).ok()?.parse().ok() };
    match COUNTS.iter().find(|name| count(name).is_some_and(|n| n > 1)) {
        Some(name) => Err(Error::value(
            name,
            "one process, since this program was built without MPI (cargo build --features mpi)",
            count(name).unwrap_or_default(),
        )),
        None => Ok(Box::new(super::ranks::Alone)),
    }
}

#[cfg(feature = "mpi")]
mod over_mpi {
    use super::{Error, Peers, Result};
    use crate::train::ranks::Ranks;
    use mpi::environment::Universe;
    use mpi::topology::SimpleCommunicator;
    use mpi::traits::{Communicator, CommunicatorCollectives, Root};

    /// Bytes of one broadcast: MPI counts elements by an i32.
    const BROADCAST: usize = 1 << 30;

    /// The ranks of `MPI_COMM_WORLD`.
    pub(super) struct Mpi {
        world: SimpleCommunicator,
        /// Finalises MPI when it is dropped.
        universe: Option<Universe>,
    }

    impl Mpi {
        /// Initialises MPI. The thread that calls it makes all calls of MPI.
        ///
        /// # Errors
        /// A process that has initialised MPI before.
        pub(super) fn connect() -> Result<Self> {
            let begun = mpi::initialize_with_threading(mpi::Threading::Funneled);
            let (universe, _) = begun.ok_or_else(|| {
                Error::value("MPI", "to be initialised once in a process", "a second time")
            })?;
            Ok(Self { world: universe.world(), universe: Some(universe) })
        }
    }

    impl Peers for Mpi {
        fn ranks(&self) -> Ranks {
            // Both are positive.
            Ranks::new(self.world.rank() as usize, self.world.size() as usize)
        }

        fn exchange(&mut self, own: Vec<u8>) -> Result<Vec<Vec<u8>>> {
            let Ranks { rank, count } = self.ranks();
            let mut lengths = vec![0u64; count];
            self.world.all_gather_into(&(own.len() as u64), &mut lengths[..]);
            let mut own = Some(own);
            let mut all = Vec::with_capacity(count);
            for (root, length) in lengths.into_iter().enumerate() {
                let sent = if root == rank { own.take() } else { None };
                let mut message = sent.unwrap_or_else(|| vec![0; length as usize]);
                let process = self.world.process_at_rank(root as i32);
                for part in message.chunks_mut(BROADCAST) {
                    process.broadcast_into(part);
                }
                all.push(message);
            }
            Ok(all)
        }
    }

    impl Drop for Mpi {
        fn drop(&mut self) {
            // Finalising waits for the other ranks. After a panic they wait for this one; without
            // it, the launcher sees the end of this process and ends them.
            if std::thread::panicking() {
                std::mem::forget(self.universe.take());
            }
        }
    }
}
