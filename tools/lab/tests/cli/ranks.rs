//! Ranks of one training, on threads: the steps and weights of one process, one error for all.

use super::train::{state, steps, tiny};
use std::path::Path;
use std::sync::{Arc, Barrier, Mutex};
use subsplat_lab::train::TrainConfig;
use subsplat_lab::train::checkpoint;
use subsplat_lab::train::ranks::{Peers, Ranks};
use subsplat_lab::train::run::{Event, Limits, Training};
use subsplat_lab::train::validate::Validator;

/// The messages of ranks on threads of one process.
struct Threads {
    ranks: Ranks,
    messages: Arc<(Mutex<Vec<Vec<u8>>>, Barrier)>,
}

impl Peers for Threads {
    fn ranks(&self) -> Ranks {
        self.ranks
    }

    fn exchange(&mut self, own: Vec<u8>) -> subsplat_lab::train::Result<Vec<Vec<u8>>> {
        let (messages, barrier) = &*self.messages;
        messages.lock().unwrap()[self.ranks.rank] = own;
        barrier.wait();
        let all = messages.lock().unwrap().clone();
        // No rank writes its next message before all have read this one.
        barrier.wait();
        Ok(all)
    }
}

/// Runs `body` for every rank of a training in `folder`, each on a thread of its own. `configs`: one
/// a rank.
fn in_ranks<R: Send>(
    configs: &[TrainConfig],
    folder: &Path,
    body: impl Fn(usize, Training) -> R + Sync,
) -> Vec<R> {
    let count = configs.len();
    let messages = Arc::new((Mutex::new(vec![Vec::new(); count]), Barrier::new(count)));
    let open = |rank: usize| {
        let peers = Threads { ranks: Ranks::new(rank, count), messages: Arc::clone(&messages) };
        Training::open_shared(&configs[rank], folder, Box::new(peers)).unwrap()
    };
    std::thread::scope(|scope| {
        let (body, open) = (&body, &open);
        let threads: Vec<_> =
            (0..count).map(|rank| scope.spawn(move || body(rank, open(rank)))).collect();
        threads.into_iter().map(|thread| thread.join().unwrap()).collect()
    })
}

/// Several ranks take the steps of one process, bit for bit, from a checkpoint too. The same over
/// MPI: `tools/lab/mpi/test.sh`.
#[test]
fn ranks_share_a_training() {
    for (phase, together) in [("depth", 1), ("render", 2)] {
        let config = TrainConfig { batch: 3, together, accumulate: 2, ..tiny(phase) };
        let [whole, shared] = [(); 2].map(|()| tempfile::tempdir().unwrap());
        let mut one = Training::open(&config, whole.path()).unwrap();
        let losses = steps(&mut one, 3);
        let expected = (losses[..2].to_vec(), state(&one));
        for count in [2, 3] {
            let folder = tempfile::tempdir().unwrap();
            let configs = vec![config.clone(); count];
            let all = in_ranks(&configs, folder.path(), |_, mut training| {
                (steps(&mut training, 3), state(&training))
            });
            for (rank, (found, weights)) in all.iter().enumerate() {
                assert_eq!(found, &losses, "{phase}, rank {rank} of {count}");
                assert!(weights == &expected.1, "{phase}, rank {rank} of {count}");
            }
        }
        let configs = [config.clone(), config.clone()];
        let ranks = in_ranks(&configs, shared.path(), |rank, mut training| {
            let found = steps(&mut training, 2);
            if rank == 0 {
                training.save().unwrap();
            }
            found
        });
        assert!(ranks.iter().all(|found| *found == expected.0), "{phase}");
        // One process goes on where two ended.
        let mut resumed = Training::open(&config, shared.path()).unwrap();
        assert_eq!((steps(&mut resumed, 1), state(&resumed)), (losses[2..].to_vec(), expected.1));
    }
}

/// The first rank writes the files; a limit of one rank ends all after the same step.
#[test]
fn ranks_end_together() {
    let config = tiny("depth");
    let folder = tempfile::tempdir().unwrap();
    let ends = in_ranks(&[config.clone(), config.clone()], folder.path(), |rank, mut training| {
        let validator = Validator::without_scenes(&config).unwrap();
        let steps = (rank == 1).then_some(2);
        let mut saved = 0;
        let limits = Limits { steps, ..Limits::default() };
        let mut count = |e: &Event| saved += usize::from(matches!(e, Event::Saved(_)));
        training.run(limits, &validator, &mut count).unwrap();
        (training.progress().step, saved)
    });
    assert_eq!(ends, [(2, 1), (2, 0)]);
    assert_eq!(checkpoint::steps(folder.path()), [2]);
    assert!(folder.path().join("weights.safetensors").is_file());
    assert!(!folder.path().join("exchange").exists());
}

/// The error of one rank ends all ranks.
#[test]
fn a_rank_that_fails_ends_all() {
    let config = tiny("depth");
    let folder = tempfile::tempdir().unwrap();
    let files = folder.path().join("run");
    let errors = in_ranks(&[config.clone(), config.clone()], &files, |rank, mut training| {
        if rank == 0 {
            // Its log has no folder.
            std::fs::remove_dir_all(&files).unwrap();
        }
        let validator = Validator::without_scenes(&config).unwrap();
        training.run(Limits::default(), &validator, &mut |_| ()).unwrap_err().to_string()
    });
    assert!(errors[0].contains("log.csv"), "{}", errors[0]);
    assert_eq!(errors[1], format!("rank 0 of 2: {}", errors[0]));
}

/// Gradients of another configuration are never added.
#[test]
fn ranks_of_another_configuration_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    // The weights are the same.
    let configs = [tiny("depth"), TrainConfig { steps: 41, ..tiny("depth") }];
    let errors = in_ranks(&configs, folder.path(), |_, mut training| {
        training.step().unwrap_err().to_string()
    });
    for text in &errors {
        assert!(text.starts_with("rank 1 of 2: expected the configuration"), "{text}");
    }
    let training = Training::open(&configs[0], folder.path()).unwrap();
    let twice = Training::open(&configs[0], folder.path()).err().unwrap().to_string();
    assert!(twice.contains("without another training"), "{twice}");
    drop(training);
}
