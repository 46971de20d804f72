// Questions that wait for an answer: a name, a confirmation, the key of the server.
import { make } from "../src/dom.js";

/** Show a form as a dialog that `labelId` names; the promise holds whether it was sent, and not left. */
export function shown(form, labelId) {
  return new Promise((answered) => {
    const box = make("dialog", { className: "ask" }, [form]);
    box.setAttribute("aria-labelledby", labelId);
    box.addEventListener("close", () => {
      box.remove();
      answered(box.returnValue === "yes");
    });
    document.body.append(box);
    box.showModal();
  });
}

/** The button that leaves a dialog. */
export const cancelButton = () => make("button", { type: "button", onClick: ({ target }) => target.closest("dialog").close("no") }, ["Cancel"]);

/** Ask with a title, words, perhaps a field, and a button; the promise holds the field's text, true, or null. */
export async function ask({ title, words, field, value = "", button, isDangerous = false, canClose = true }) {
  const input = field && make("input", { type: "text", value, id: "ask-field", maxLength: 400, autocomplete: "off", required: true });
  const form = make("form", { method: "dialog" }, [
    make("h2", { id: "ask-title" }, [title]),
    ...words.map((sentence) => make("p", {}, [sentence])),
    ...(field ? [make("label", { htmlFor: "ask-field" }, [field]), input] : []),
    make("div", { className: "ask-buttons" }, [
      ...(canClose ? [cancelButton()] : []),
      make("button", { type: "submit", className: isDangerous ? "danger" : "primary", value: "yes" }, [button]),
    ]),
  ]);
  const answer = shown(form, "ask-title");
  if (!canClose) form.closest("dialog").addEventListener("cancel", (event) => event.preventDefault());
  input?.select();
  return (await answer) ? (input ? input.value.trim() : true) : null;
}

let isAsking = false;

/** The server has another key than the page: explain it and take the new one; the page opens where it was. */
export async function askForKey() {
  if (isAsking) return;
  isAsking = true;
  const words = [
    "The server was started again and has a new key, so it does not answer this page any more. Your cases are kept.",
    "The terminal in which vstent app runs shows the new address.",
  ];
  const key = await ask({ title: "The server has a new key", words, field: "New address or key", button: "Open the page", canClose: false });
  isAsking = false;
  location.href = `/?token=${encodeURIComponent(key.split("token=").pop())}${location.hash}`;
}
