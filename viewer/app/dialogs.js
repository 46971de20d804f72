// Questions that wait for an answer: a name, a confirmation, the key of the server.
import { make } from "../src/dom.js";

/** Ask with a title, words, perhaps a field, and a button; the promise holds the field's text, true, or null. */
export function ask({ title, words, field, value = "", button, isDangerous = false, canClose = true }) {
  return new Promise((answered) => {
    const input = field && make("input", { type: "text", value, id: "ask-field", maxLength: 400, autocomplete: "off", required: true });
    const form = make("form", { method: "dialog" }, [
      make("h2", { id: "ask-title" }, [title]),
      ...words.map((sentence) => make("p", {}, [sentence])),
      ...(field ? [make("label", { htmlFor: "ask-field" }, [field]), input] : []),
      make("div", { className: "ask-buttons" }, [
        ...(canClose ? [make("button", { type: "button", onClick: () => box.close("no") }, ["Cancel"])] : []),
        make("button", { type: "submit", className: isDangerous ? "danger" : "primary", value: "yes" }, [button]),
      ]),
    ]);
    const box = make("dialog", { className: "ask" }, [form]);
    box.setAttribute("aria-labelledby", "ask-title");
    box.addEventListener("close", () => {
      box.remove();
      answered(box.returnValue === "yes" ? (input ? input.value.trim() : true) : null);
    });
    if (!canClose) box.addEventListener("cancel", (event) => event.preventDefault());
    document.body.append(box);
    box.showModal();
    input?.select();
  });
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
